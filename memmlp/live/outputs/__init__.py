"""Where a live body goes while it is there: other programs, and files."""
