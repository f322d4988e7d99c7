"""Imports recordings on any skeleton as clips with 22 joints, and compares clips with recordings."""
