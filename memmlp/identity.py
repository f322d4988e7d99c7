"""The identity of a run: a digest of all that can change its result."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from memmlp.files import plain

RECIPE = 1
"""Part of every identity: raise it when the code's results change for an unchanged config."""

IGNORED = (
    "data",  # its digest stands for it: frames, clips, split and rest pose
    "profile",  # sizes, read by the groups that use them
    "paths",
    "tracker",
    "device",
    "threads",
    "force",
    "save_predictions",
    "optim.checkpoint_every",
    "optim.log_every",
    "export",  # how long the clock runs
    "hydra",
)
"""Config keys that cannot change a run's result, and so are no part of its identity."""


NEUTRAL: Mapping[str, Any] = {
    "evaluation.ik": "off",
    "evaluation.ik_iterations": 15,
}
"""Keys that came after the first release, with the value that stands for what was before: at it they are no
part of the identity, so that runs made before them stay known."""


def run_id(kind: str, config: Mapping[str, Any], *, data: str, upstream: str | None) -> str:
    """The identity of a run: 16 hex digits over all that can change its result.

    Args:
        kind: the stage ("vqvae", "memmlp").
        config: resolved config; IGNORED keys do not count, nor does 1 against 1.0.
        data: digest of the prepared data. upstream: id of the run whose artifact this one uses.
    """
    what = {"recipe": RECIPE, "kind": kind, "config": relevant(config), "data": data, "upstream": upstream}
    text = json.dumps(plain(what), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def relevant(config: Mapping[str, Any]) -> dict[str, Any]:
    """The dotted keys of a config that are part of the identity."""

    def counts(key: str) -> bool:
        return not any(key == ignored or key.startswith(f"{ignored}.") for ignored in IGNORED)

    flat = {key: _canonical(value) for key, value in flatten(config).items() if counts(key)}
    return {key: value for key, value in flat.items() if key not in NEUTRAL or value != NEUTRAL[key]}


def _canonical(value: Any) -> Any:
    """The same value for the same number, however it was typed."""
    if isinstance(value, list | tuple):
        return [_canonical(item) for item in value]
    if isinstance(value, float) and value.is_integer():
        return int(value)
    return value


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """A nested mapping with dotted keys; lists stay values."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping) and value:
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat
