"""Prepares a folder of clips: splits the clips, and writes a memory-mappable cache."""
