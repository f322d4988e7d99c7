"""A run's name for people, the same in lists, on the page and in trackers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

SLOTS = ("model", "memory", "predictor")
USUAL = {"model": "mem_mlp", "predictor": "two_branch"}


def kind_words(kind: str) -> str:
    """Return what people call a kind of run that networks build upon, such as "lower codes"."""
    return "VQ-VAE" if kind == "vqvae" else kind.replace("_", " ")


def run_name(manifest: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """Return the name that a run was given when it began: what its config has that a default one has not.

    A run from before there were such names has its model, memory and predictor in place of it.

    Args:
        manifest: the run's manifest.
        config: its config by dotted key.
    """
    if manifest.get("name"):
        return str(manifest["name"])
    seed = config.get("seed")
    ending = "" if seed is None else f" · seed {seed}"
    if manifest.get("kind") == "vqvae":
        return f"VQ-VAE{ending}"
    slots = {slot: config.get(f"{slot}.name") for slot in SLOTS}
    words = [f"{slot}={value}" for slot, value in slots.items() if value not in (None, USUAL.get(slot))]
    return (" ".join(words) or str(manifest.get("kind") or "run")) + ending
