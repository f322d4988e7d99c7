"""Mem-MLP: full-body motion from three tracked points, and the platform for its ablations."""

__version__ = "0.1.0"
