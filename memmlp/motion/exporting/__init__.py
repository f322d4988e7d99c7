"""From clips on the 22-joint tree to files that other programs open."""
