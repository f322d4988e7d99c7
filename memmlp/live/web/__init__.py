"""A static site that times networks in the visitor's browser, plays clips, and runs on headsets."""
