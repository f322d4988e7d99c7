"""A static site that times networks in the browser it is opened in, plays clips, and is worn."""
