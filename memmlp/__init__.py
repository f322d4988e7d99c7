"""Mem-MLP: full-body motion from three tracked points, and the platform for its ablations."""

from importlib import import_module
from typing import Any

__version__ = "0.2.0"


def __getattr__(name: str) -> Any:
    """`memmlp.Stream`, imported when it is asked for."""
    if name == "Stream":
        return import_module("memmlp.live.stream").Stream
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
