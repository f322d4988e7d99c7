"""The folders of data in the package: conf and sweeps."""

from __future__ import annotations

from pathlib import Path

import memmlp


def packaged(name: str) -> Path:
    """Return the folder `conf` or `sweeps`.

    In a checkout, the folder is beside the package. In an installed package, it is inside, named `_conf` or
    `_sweeps`.
    """
    package = Path(memmlp.__file__).resolve().parent
    installed = package / f"_{name}"
    return installed if installed.is_dir() else package.parent / name
