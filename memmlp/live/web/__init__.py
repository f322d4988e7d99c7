"""A static website that times networks in the browser, plays clips, and runs on headsets."""
