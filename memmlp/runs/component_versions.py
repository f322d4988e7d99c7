"""Component versions: one for every component on which a result's numbers depend.

A run's identity contains the versions of the components that it uses. Whoever changes what a component
computes raises its version in the same commit, in its declaration (`memmlp.common.components`) or here. Then
exactly the runs that used it are outdated and are made again. `tests/test_golden.py` computes a few steps of
every component and fails until that is done. Moving or renaming code changes no version.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from memmlp.common.components import declared

VERSIONS: dict[str, int] = {
    # what networks see (memmlp.motion)
    "features": 1,
    # parts of networks that are no option of a slot
    "vqvae": 1,
    "codebook.ema": 1,
    "codebook.gradient": 1,
    # how they are trained (memmlp.training)
    "sampler": 1,
    "mirror": 2,
    "training": 1,
    "schedule.step": 1,
    "schedule.cosine": 1,
    "schedule.milestones": 1,
    "ema": 1,
    "warmup": 1,
    "precision.bf16": 2,
    "weighting.learned": 2,
    # how they are evaluated (memmlp.evaluation)
    "metrics": 1,
    "mode.stream": 1,
    "mode.window": 3,
    "ik.lbfgs": 1,
    "ik.arms": 1,
    # how they are deployed (memmlp.deploy)
    "export": 1,
    "graph.streaming": 1,
    "graph.naive": 1,
    "int8": 3,
    "int8_blocks": 3,
    "fp16": 3,
    "latency": 1,
}
"""The versions of what is no option of a slot."""


def version_of(component: str) -> int:
    """Return the version of a component, named SLOT.NAME or as in VERSIONS; 0 if it is not in use."""
    slot, _, name = component.partition(".")
    found = declared().get((slot, name))
    return VERSIONS.get(component, found.version if found else 0)


def find_versions(components: Iterable[str]) -> dict[str, int]:
    """Return the versions of components by name; 0 for a component that is not in use."""
    return {name: version_of(name) for name in sorted(components)}


def outdated(recorded: Mapping[str, int]) -> list[str]:
    """Describe the recorded component versions that differ from the current ones: "name old -> new"."""
    now = find_versions(recorded)
    return [f"{name} {number} -> {now[name]}" for name, number in recorded.items() if now[name] != number]
