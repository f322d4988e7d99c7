"""The folders that travel with the package: conf and sweeps, of the checkout or inside the wheel."""

from __future__ import annotations

from pathlib import Path

import memmlp


def shipped(name: str) -> Path:
    """The folder `conf` or `sweeps`: beside the package in a checkout, in it, with `_`, when installed."""
    package = Path(memmlp.__file__).resolve().parent
    installed = package / f"_{name}"
    return installed if installed.is_dir() else package.parent / name
