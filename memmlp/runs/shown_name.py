"""A run's readable name, which is the same in lists, on the page and in loggers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

SLOTS = ("model", "memory", "predictor")
USUAL = {"model": "mem_mlp", "predictor": "two_branch"}


def kind_words(kind: str) -> str:
    """Return the readable name of an upstream run's kind, such as "lower codes"."""
    return "VQ-VAE" if kind == "vqvae" else kind.replace("_", " ")


def run_name(manifest: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """Return the name that a run got when it began, which tells how its config differs from the default.

    An older run without such a name is named by its model, memory and predictor.

    Args:
        manifest: the run's manifest.
        config: the run's config, by dotted key.
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
