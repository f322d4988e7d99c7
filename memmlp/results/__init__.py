"""Results that are kept with the code, and the pages that are made of them."""
