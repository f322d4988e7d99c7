"""Names that people can read: which sweep's arm and seed a run is, or what it is by its config."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from memmlp.sweep.plan import Plan

SLOTS = ("model", "memory", "predictor")


def places(
    plans: Iterable[Plan], trials: Iterable[tuple[str, int, str]] = ()
) -> dict[str, list[dict[str, Any]]]:
    """Return, by run id, the sweeps in which a run stands, each with arm and seed, and searches with trials.

    `trials` are the name of a search, the number of a trial and the id of one of its runs.
    """
    found: dict[str, list[dict[str, Any]]] = {}
    for plan in plans:
        for entry in plan.entries:
            found.setdefault(entry.id, []).append(
                {"sweep": plan.name, "arm": entry.label, "seed": entry.seed}
            )
    for search, number, run_id in trials:
        found.setdefault(run_id, []).append({"search": search, "trial": number})
    return found


def name(facts: Mapping[str, Any], places: Iterable[Mapping[str, Any]]) -> str:
    """Return a run's name: its arm and seed, or else its model, its memory and its seed."""
    config = facts["config"]
    seed = config.get("seed")
    ending = "" if seed is None else f" · seed {seed}"
    for place in places:
        return (
            f"{place['arm']} · seed {place['seed']}" if "arm" in place else f"trial {place['trial']}{ending}"
        )
    if facts["kind"] == "vqvae":
        return f"VQ-VAE{ending}"
    slots = {slot: config.get(f"{slot}.name") for slot in SLOTS}
    usual = {"model": "mem_mlp", "predictor": "two_branch"}
    words = [f"{slot}={value}" for slot, value in slots.items() if value not in (None, usual.get(slot))]
    return (" ".join(words) or facts["kind"] or "run") + ending
