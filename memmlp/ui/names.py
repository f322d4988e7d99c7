"""Names that people can read: which sweep's arm and seed a run is, or what it is by its config."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from memmlp.sweep.plan import Plan


def places(plans: Iterable[Plan]) -> dict[str, list[dict[str, Any]]]:
    """Return, by run id, the sweeps in which a run stands, each with arm and seed."""
    found: dict[str, list[dict[str, Any]]] = {}
    for plan in plans:
        for entry in plan.entries:
            found.setdefault(entry.id, []).append({"sweep": plan.name, "arm": entry.label, "seed": entry.seed})
    return found


def name(facts: Mapping[str, Any], places: Iterable[Mapping[str, Any]]) -> str:
    """Return a run's name: its arm and seed, or else its model, its memory and its seed."""
    config = facts["config"]
    seed = config.get("seed")
    ending = "" if seed is None else f" · seed {seed}"
    for place in places:
        return f"{place['arm']} · seed {place['seed']}"
    if facts["kind"] == "vqvae":
        return f"VQ-VAE{ending}"
    parts = [config.get("model.name"), config.get("memory.name")]
    words = [str(part) for part in parts if part not in (None, "mem_mlp")]
    return (" ".join(words) or facts["kind"] or "run") + ending
