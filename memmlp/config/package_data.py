"""The folders of data in the package, conf and sweeps, and the shipped groupings of clips."""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path

import yaml

import memmlp

DEFAULT = "cmu"  # the grouping of data=mocap


def packaged(name: str) -> Path:
    """Return the folder `conf` or `sweeps`.

    In a checkout, the folder is beside the package. In an installed package, it is inside, named `_conf` or
    `_sweeps`.
    """
    package = Path(memmlp.__file__).resolve().parent
    installed = package / f"_{name}"
    return installed if installed.is_dir() else package.parent / name


def grouping_to_choose(names: Collection[str]) -> str | None:
    """Return the shipped grouping that `data=mocap` needs for these clips; None if it has the right one.

    Args:
        names: clips' names below their folder, without `.npz`.
    """
    fitting = {
        path.stem
        for path in (packaged("conf") / "data" / "grouping").glob("*.yaml")
        for pattern in yaml.safe_load(path.read_text(encoding="utf-8"))["groups"]
        if any(re.search(pattern, name) for name in names)
    }
    return None if DEFAULT in fitting else min(fitting, default=None)
