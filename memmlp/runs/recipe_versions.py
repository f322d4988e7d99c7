"""Recipe versions: one for every component on which a result's numbers depend.

A run's identity contains the numbers of the components that it uses. Whoever changes what a component
computes raises its number in the same commit: then exactly the runs that used it have an outdated recipe and
are made again. `tests/test_golden.py` computes a few steps of every component and fails until that is done.
Moving or renaming code changes no number. Users' packages add numbers for their components
(memmlp.config.plugins).
"""

from __future__ import annotations

from collections.abc import Mapping

RECIPES: dict[str, int] = {
    # the motion that is made, which is known by the data's digest; the number names its folder
    "synthetic": 1,
    # what the network sees, and how its space lies in the world (memmlp.motion)
    "features": 1,
    "coordinates.heading": 1,
    "coordinates.head_relative": 1,
    "coordinates.world": 1,
    # networks (memmlp.networks)
    "model.mem_mlp": 1,
    "model.agrol_mlp": 1,
    "model.agrol_diffusion": 1,
    "model.bodiffusion": 2,
    "model.avatar_poser": 2,
    "model.ego_poser": 2,
    "model.hmd_poser": 1,
    "model.vae_hmd": 1,
    "model.rpm": 1,
    "model.avatar_jlm": 2,
    "model.recurrent_poser": 3,
    "model.sage": 1,
    "model.manikin_s": 3,
    "model.manikin_l": 2,
    "model.still_pose": 1,
    "memory.vq": 1,
    "memory.vq_joint": 1,
    "memory.no_codes": 1,
    "memory.lstm": 1,
    "memory.gru": 1,
    "memory.none": 1,
    "predictor.two_branch": 1,
    "predictor.two_branch_memory": 1,
    "predictor.rotation_only": 1,
    "predictor.rotation_only_memory": 1,
    "refiner.sage": 1,
    "upstream.sage": 3,
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
    "optim.muon": 1,
    "optim.schedule_free": 1,
    "ema": 1,
    "warmup": 1,
    "precision.bf16": 2,
    "rollout.teacher_forcing": 1,
    "rollout.own_predictions": 1,
    "rollout.streams": 2,
    "loss.uncertainty": 1,
    "loss.manual": 1,
    "loss.agrol": 1,
    "loss.avatar_poser": 1,
    "loss.own": 1,
    "loss.rpm": 1,
    "loss.terms": 1,
    "weighting.learned": 2,
    "hand.position": 1,
    "hand.fk": 1,
    "hand.off": 1,
    # how they are evaluated (memmlp.evaluation)
    "metrics": 1,
    "mode.stream": 1,
    "mode.window": 3,
    "ik.lbfgs": 1,
    "ik.arms": 1,
    # how they are deployed (memmlp.deploy, memmlp.networks.streaming)
    "export": 1,
    "graph.streaming": 1,
    "graph.naive": 1,
    "int8": 3,
    "int8_blocks": 3,
    "fp16": 3,
    "latency": 1,
}


def outdated(known: Mapping[str, int]) -> list[str]:
    """Describe which of the known recipe versions, by component, are different now: "name old -> new"."""
    now = recipes(list(known))
    return [f"{name} {number} -> {now[name]}" for name, number in known.items() if now[name] != number]


def recipes(components: list[str]) -> dict[str, int]:
    """Return the recipe versions of components by name; 0 for a component that is not in this package."""
    return {name: RECIPES.get(name, 0) for name in sorted(components)}


def first_of_vqvae(known: Mapping[str, int], codebook: str | None = None) -> dict[str, int]:
    """Return the recipe versions of a VQ-VAE from before these were kept with the networks upon it.

    Args:
        known: the recipe versions that are known of a network and its upstream runs, by component.
        codebook: the kind of the VQ-VAE's codebook; None for the default.

    Returns:
        The first versions of VQ-VAE and codebook; empty if they are known, or if there is no VQ-VAE upstream.
    """
    lacking = "memory.vq" in known and "vqvae" not in known
    return {"vqvae": 1, f"codebook.{codebook or 'ema'}": 1} if lacking else {}
