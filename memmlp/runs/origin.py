"""The origin of a run: machines and code of its training, and the prerequisite runs whose weights it uses.

The id of a prerequisite run says how it is trained, not which weights came of it: trained again, or on
another machine, it has others. So a run's manifest has the origins of both, as they were when it began.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from memmlp.runs.environment import MIXED, changed

MACHINE = ("device", "gpu", "gpu_index", "threads", "processes", "precision", "cpu")
"""What can change a result's last digits, and which of a machine's GPUs it was."""

PREREQUISITES = "prerequisite_runs"
"""The key of the manifest with the origins of a run's prerequisite runs."""

FACTS = ("component_versions", "git", "version", "sources", "plugins", "packages", *MACHINE)
"""What the manifest of a prerequisite run has on its code and its machine."""


def prerequisite_origins(manifest: Mapping[str, Any], weights: str | None) -> list[dict[str, Any]]:
    """Return the origins of the prerequisite runs of a run that begins, the nearest first.

    Each has the run's `id` and `kind`, the SHA-256 of its `weights`, and FACTS as far as known.

    Args:
        manifest: the manifest of the finished run whose weights the run uses.
        weights: the SHA-256 of these weights.
    """
    own = {"id": manifest.get("id"), "kind": manifest.get("kind"), "weights": weights}
    facts = {name: manifest[name] for name in FACTS if name in manifest}
    return [own | facts, *recorded_prerequisites(manifest)]


def recorded_prerequisites(manifest: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the origins of the prerequisite runs in a run's manifest."""
    return manifest.get(PREREQUISITES) or []


def prerequisite_versions(manifest: Mapping[str, Any]) -> dict[str, int]:
    """Return the component versions with which a run's prerequisite runs were trained, from its manifest."""
    every = [one.get("component_versions") or {} for one in recorded_prerequisites(manifest)]
    return {name: number for versions in every for name, number in versions.items()}


def join_origins(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    """Join the origins of a training before and after it was resumed; if they differ, both are kept.

    A file whose code changed in between gets "mixed" in place of a digest. Prerequisite runs that changed
    since (trained again, under the same ids) follow the present ones.

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
    found["sources"] = after["sources"] | dict.fromkeys(changed(known, after["sources"]), MIXED)
    prerequisite = after.get(PREREQUISITES, [])
    if earlier := [one for one in before.get(PREREQUISITES, []) if one not in prerequisite]:
        found[PREREQUISITES] = [*prerequisite, *earlier]
    for name, package in (before.get("plugins") or {}).items():
        now = (after.get("plugins") or {}).get(name, package)
        if now["digest"] != package["digest"]:
            found["plugins"] = {**found["plugins"], name: {**now, "digest": MIXED}}
    return found
