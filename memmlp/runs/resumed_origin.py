"""The origin of a resumed training: every machine and code version that had a part in it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from memmlp.runs.environment import changed

MACHINE = ("device", "gpu", "gpu_index", "threads", "processes", "precision", "cpu")
"""What can change a result's last digits, and which of a machine's GPUs it was."""

UPSTREAM = "upstream_runs"
"""The key of the manifest with the origins of a run's upstream runs."""


def joined(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    """Join the origins of a training before and after it was resumed; if they differ, both are kept.

    A file whose code changed in between gets "mixed" in place of a digest. Upstream runs that have become
    others since (trained again, under the same ids) follow those of today.

    Args:
        before: the manifest so far, empty for a training from the start.
        after: the origin of the resumed training.
    """
    found = dict(after)
    for key in MACHINE:
        words = [before[key]] if key in before and before[key] != after.get(key) else []
        found[key] = ", ".join(map(str, [*words, after[key]])) if words else after.get(key)
    old, new = before.get("git"), after.get("git")
    if old and new:
        other = old.get("before") or (old["commit"] if old["commit"] != new["commit"] else None)
        found["git"] = {**new, "dirty": old["dirty"] or new["dirty"]} | ({"before": other} if other else {})
    known = before.get("sources", after["sources"])
    found["sources"] = after["sources"] | dict.fromkeys(changed(known, after["sources"]), "mixed")
    upstream = after.get(UPSTREAM, [])
    if earlier := [one for one in before.get(UPSTREAM, []) if one not in upstream]:
        found[UPSTREAM] = [*upstream, *earlier]
    for name, package in (before.get("plugins") or {}).items():
        now = (after.get("plugins") or {}).get(name, package)
        if now["digest"] != package["digest"]:
            found["plugins"] = {**found["plugins"], name: {**now, "digest": "mixed"}}
    return found
