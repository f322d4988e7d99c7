"""Files of motion: what reads and writes each format."""
