"""The groupings of `conf/data/grouping`: patterns of clips that belong together, by collection."""

from __future__ import annotations

import re
from collections.abc import Collection

import yaml

from memmlp.config.package_data import packaged

DEFAULT = "cmu"  # that of data=mocap


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
