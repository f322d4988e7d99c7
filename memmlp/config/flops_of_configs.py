"""Counts the operations of configs' trainings without running them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from omegaconf import DictConfig, OmegaConf

from memmlp.common.errors import InputError
from memmlp.common.files import digest
from memmlp.config.build import build_architecture, build_training, config_of
from memmlp.config.compose import composed
from memmlp.motion.body import builtin_rest_joints
from memmlp.motion.normalizer import Normalizer
from memmlp.sweep.definition import Sweep
from memmlp.tables.effects import RunsBySeed
from memmlp.tables.effects_along_axes import in_cells
from memmlp.tables.measured_run import Measured
from memmlp.training.train_network import NetworkTraining
from memmlp.training.training_flops import training_flops

ELSEWHERE = ("seed", "data", "paths", "profile", "loggers", "evaluation", "export", "device", "threads")
"""Groups and keys on which a training's number of operations does not depend."""


def flops_of(cfg: DictConfig) -> int:
    """Count the FLOPs of a checked config's training (see `memmlp.training.training_flops`).

    Raises:
        InputError: for a refiner, since its training is not counted.
    """
    training = build_training(cfg, {})
    if not isinstance(training, NetworkTraining):
        raise InputError("refiner: the operations of its training are not counted; allowed is refiner=null")
    architecture = build_architecture(cfg)
    with torch.random.fork_rng(devices=[]):
        codes = architecture.vqvae().eval() if architecture.uses_codes else None
        rest = torch.as_tensor(builtin_rest_joints(), dtype=torch.float32)
        model = architecture.build(Normalizer.raw(architecture.coordinates, rest), codes)
        return training_flops(model, training.loss(model.branches), training.optim)


def with_flops(runs: Mapping[str, RunsBySeed]) -> dict[str, RunsBySeed]:
    """Return finished runs with the FLOPs of their trainings, each counted from its own config.

    Runs that are kept without their folders are left unchanged.
    """
    known: dict[str, int] = {}

    def count(run: Measured) -> Measured:
        if run.run is None:
            return run
        cfg = config_of(run.run)
        config = OmegaConf.to_container(cfg, resolve=True)
        assert isinstance(config, dict)
        key = digest({name: value for name, value in config.items() if name not in ELSEWHERE})
        if key not in known:
            known[key] = flops_of(cfg)
        return replace(run, training={**run.training, "flops": float(known[key])})

    return {label: {seed: count(run) for seed, run in seeds.items()} for label, seeds in runs.items()}


def predicted_flops(sweep: Sweep) -> dict[str, float]:
    """Count the FLOPs of training the effects' control arm, with `scale.predict` in place of its cell.

    Returns:
        The number, by these overrides as one line; empty if nothing is to be predicted.

    Raises:
        InputError: if effects have different controls, whose trainings would have different numbers.
    """
    words = sweep.scale.predict if sweep.scale else ()
    controls = {other.own_overrides: other for _, other in in_cells(sweep)}
    if not words or not controls:
        return {}
    if len(controls) > 1:
        known = ", ".join(f"'{control.label}'" for control in controls.values())
        raise InputError(
            f"sweep {sweep.name}: scale.predict: allowed is one control, not {known}; put it first"
        )
    ((own, control),) = controls.items()
    elsewhere = replace(control, overrides=(*own, *words))
    return {" ".join(words): float(flops_of(composed(list(sweep.all_overrides(elsewhere)))))}
