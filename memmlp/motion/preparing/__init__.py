"""Turns a folder of clips into a split, memory-mappable cache."""
