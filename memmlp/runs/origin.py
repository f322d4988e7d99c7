"""What a training was made on and by."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

MACHINE = ("device", "gpu", "threads", "precision", "cpu")  # what can change a result's last digits


def joined(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    """What a training was made on and by that was resumed: where the two differ, both.

    A file whose code changed in between has no digest that any code has.
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
    found["sources"] = {
        name: digest if known.get(name) == digest else "mixed" for name, digest in after["sources"].items()
    }
    return found
