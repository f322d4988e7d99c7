"""Builds the objects that a composed config describes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from memmlp.common.errors import InputError
from memmlp.common.plugin import METRICS
from memmlp.config import plugins
from memmlp.config.build_motion import shares
from memmlp.config.build_request import build_request
from memmlp.config.compose import composed
from memmlp.config.instantiate import built, located
from memmlp.config.name_from_config import readable_name
from memmlp.config.schema import check, restored
from memmlp.deploy.deployment import Deployment
from memmlp.evaluation.evaluation import Evaluation
from memmlp.evaluation.ik import IK, LBFGS, Arms, NoIK
from memmlp.evaluation.metrics import UserMetric
from memmlp.motion.body import builtin_rest_joints
from memmlp.motion.network_coordinates import Coordinates, Heading, HeadRelative, World
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.architectures import (
    Architecture,
    MemMLPArchitecture,
    PartedArchitecture,
    PlainArchitecture,
    RefinedArchitecture,
)
from memmlp.networks.memory import Memory
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.vqvae import VQVAE
from memmlp.runs.identity import VQVAE_SHAPE
from memmlp.runs.loggers.logger import Loggers
from memmlp.runs.lookup import check_trained
from memmlp.runs.run import Run
from memmlp.training.devices import device
from memmlp.training.experiment import Experiment, PrerequisiteTraining
from memmlp.training.losses import Loss, MotionLoss, Term
from memmlp.training.optim import Optim, vqvae_optim
from memmlp.training.train_network import NetworkTraining
from memmlp.training.train_refiner import RefinerTraining
from memmlp.training.train_vqvae import VQVAETraining

COORDINATES: dict[str, type[Coordinates]] = {
    "head_relative": HeadRelative,
    "world": World,
    "heading": Heading,
}


def build_experiment(cfg: DictConfig, elsewhere: bool = False) -> Experiment:
    """Build the experiment of a checked config.

    Args:
        cfg: the config.
        elsewhere: whether other processes will perform it, perhaps on another machine, so that this machine
            need not have its device.

    Raises:
        InputError: if the config's device, or the code of a custom component, does not exist here.
    """
    unrefined = build_experiment(_unrefined(cfg), elsewhere) if cfg.refiner is not None else None
    request = build_request(cfg)
    metrics = build_metrics(cfg.evaluation.metrics)
    return Experiment(
        config=request.config,
        motion=request.motion,
        device=torch.device("cpu") if elsewhere else device(cfg.device),
        architecture=build_architecture(cfg),
        prerequisites=build_prerequisites(cfg, request.config),
        training=build_training(cfg, metrics),
        evaluation=Evaluation(
            modes=list(cfg.evaluation.modes),
            batch=cfg.evaluation.batch,
            ik=build_ik(cfg),
            seed=cfg.seed,
            metrics=metrics,
        ),
        deployment=build_deployment(cfg),
        loggers=build_loggers(cfg),
        make_name=readable_name,
        unrefined=unrefined,
    )


def _unrefined(cfg: DictConfig) -> DictConfig:
    """Return the config of the same network without its refiner, not forced and without saved predictions."""
    bare = cfg.copy()
    bare.refiner, bare.force, bare.save_predictions = None, False, None
    return bare


def build_prerequisites(cfg: DictConfig, config: dict[str, Any]) -> tuple[PrerequisiteTraining, ...]:
    """Build the trainings of the runs that a checked config's network builds upon, in order.

    The only prerequisite of a refiner is its network's run.

    Args:
        cfg: the config.
        config: the same config, resolved.
    """
    if cfg.refiner is not None:
        return ()
    if cfg.upstream is not None:
        training = build_training(cfg, {})
        assert isinstance(training, NetworkTraining)
        return tuple(built(cfg.upstream).trainings(config, training))
    if cfg.memory is None or not memory_class(cfg).uses_codes:
        return ()
    optim = partial(build_vqvae_optim, cfg)
    return (VQVAETraining(seed=cfg.vqvae.seed, optim=optim, mirror=cfg.data.mirror),)


def build_training(cfg: DictConfig, metrics: dict[str, UserMetric]) -> NetworkTraining | RefinerTraining:
    """Build the training of a checked config's network, or of the refiner behind it."""
    common = {"seed": cfg.seed, "optim": built(cfg.optim), "drawn_by": cfg.data.drawn_by}
    common |= {"shares": shares(cfg.data), "mirror": cfg.data.mirror, "metrics": metrics}
    if cfg.refiner is not None:
        refiner = built(cfg.refiner)
        return RefinerTraining(refiner=refiner, **common | {"optim": common["optim"].at(refiner.lr)})
    return NetworkTraining(loss=build_loss(cfg), rollout=built(cfg.rollout), **common)


def untrained(overrides: Sequence[str]) -> MotionModel:
    """Build the network for a command line's overrides, with random weights, on the built-in body."""
    architecture = build_architecture(composed(list(overrides)))
    torch.manual_seed(0)
    codes = architecture.vqvae() if architecture.uses_codes else None
    normalizer = Normalizer.raw(architecture.coordinates, torch.as_tensor(builtin_rest_joints()))
    return architecture.build(normalizer, codes).eval()


def build_loggers(cfg: DictConfig) -> Loggers:
    """Build the loggers of a config, in which its runs are shown."""
    outputs = Path(cfg.paths.outputs)
    return Loggers(tuple(built(node, outputs=outputs) for node in cfg.loggers.values()), outputs)


def build_architecture(cfg: DictConfig) -> Architecture:
    """Build the architecture of a checked config, which makes and loads the network."""
    network = build_unrefined_architecture(cfg)
    if cfg.refiner is None:
        return network
    common = {name: getattr(network, name) for name in ("coordinates", "normalize", "vqvae")}
    return RefinedArchitecture(**common, network=network, refiner=built(cfg.refiner))


def build_unrefined_architecture(cfg: DictConfig) -> Architecture:
    """Build the architecture of a checked config's network, without a refiner."""
    vqvae = partial(VQVAE, **{name: cfg.vqvae[name] for name in VQVAE_SHAPE})
    coordinates = build_coordinates(cfg.normalizer.coordinates)
    common = {"coordinates": coordinates, "normalize": cfg.normalizer.z_scores, "vqvae": vqvae}
    if "_target_" in cfg.model:
        family = PlainArchitecture if cfg.upstream is None else PartedArchitecture
        return family(**common, network=built(cfg.model))
    memory, kind = built(cfg.memory), memory_class(cfg)
    return MemMLPArchitecture(
        **common,
        frames=cfg.model.frames,
        hidden=cfg.model.width,
        depth=cfg.model.depth,
        memory=partial(memory, vqvae=vqvae) if kind.trains_codes else memory,
        memory_kind=kind,
        predictor=built(cfg.predictor),
    )


def build_coordinates(name: str) -> Coordinates:
    """Build the coordinates with that name, or those of a custom class with that path."""
    if name in COORDINATES:
        return COORDINATES[name]()
    found = located(name, "normalizer.coordinates")
    if not (isinstance(found, type) and issubclass(found, Coordinates)):
        allowed = f"a class that extends {Coordinates.__module__}.Coordinates"
        raise InputError(f"normalizer.coordinates={name}: allowed is {allowed}")
    return found()


def build_metrics(names: Iterable[str]) -> dict[str, UserMetric]:
    """Return the custom metrics with these names."""
    own = {name: METRICS[name] for name in names}
    return {
        name: UserMetric(located(metric.function, f"metric {name}"), metric.of)
        for name, metric in own.items()
    }


def memory_class(cfg: DictConfig) -> type[Memory]:
    """Return the class in the memory slot."""
    return get_class(cfg.memory._target_)


def build_loss(cfg: DictConfig) -> Callable[[frozenset[str]], Loss]:
    """Return a function that makes the loss for a network's branches.

    Mem-MLP's loss is put together from the weighting, the hand term, a custom term and the branches. A
    baseline's loss is complete and ignores the branches.

    Raises:
        InputError: for a custom term beside a complete loss, or for a branch that the predictor lacks.
    """
    loss = built(cfg.loss)
    if isinstance(loss, Loss):
        if cfg.term is not None:
            raise InputError(
                f"term={cfg.term.name}: loss={cfg.loss.name} is a whole loss; allowed is term=null"
            )
        return lambda branches: loss
    term = built(cfg.term) if cfg.term is not None else Term()
    branches: frozenset[str] = get_class(cfg.predictor._target_).branches  # type: ignore[attr-defined]
    if cfg.term is not None and term.branch not in branches:
        lacking = f"looks at the {term.branch} branch, which predictor={cfg.predictor.name} lacks"
        raise InputError(f"term={cfg.term.name}: {lacking}; allowed is a term of {' or '.join(branches)}")
    return partial(MotionLoss, loss, built(cfg.hand), term=term)


def build_deployment(cfg: DictConfig) -> Deployment | None:
    """Build the deployment of a checked config's network; None if it is not deployed."""
    return None if cfg.export.graph == "off" else Deployment(**cfg.export)


def build_ik(cfg: DictConfig) -> IK:
    """Build the inverse kinematics of a checked config."""
    solvers: dict[str, IK] = {"off": NoIK(), "lbfgs": LBFGS(cfg.evaluation.ik_iterations), "arms": Arms()}
    return solvers[cfg.evaluation.ik]


def build_vqvae_optim(cfg: DictConfig, frames: int) -> Optim:
    """Build the optimisation of the VQ-VAE, whose length may be given in epochs.

    An epoch has as many frames as the training part (`frames`).
    """
    own, often = cfg.vqvae, {name: cfg.optim[name] for name in ("checkpoint_every", "log_every")}
    steps = own.steps or math.ceil(own.epochs * frames / own.batch)
    return vqvae_optim(steps, own.batch, own.lr, own.weight_decay, **often)


def config_of(run: Run, overrides: Sequence[str] = ()) -> DictConfig:
    """Return the typed and checked config of a finished run of a motion network.

    Args:
        run: the run.
        overrides: KEY=VALUE words that replace keys of its config.

    Raises:
        InputError: if the run is not finished, its config does not fit this version, an override is wrong, or
            custom code is not here or was not allowed to be imported.
    """
    check_trained(run)
    plugins.activate(plugins.named(overrides))
    plugins.check_allowed(run.config, run.manifest.get("plugins") or {}, f"run {run.id}")
    try:
        cfg = restored(run.config)
    except (OmegaConfBaseException, KeyError, TypeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{run.config_path}: not a config of this version of memmlp ({reason})") from None
    for word in overrides:
        _override(cfg, word)
    check(cfg)
    return cfg


def _override(cfg: DictConfig, word: str) -> None:
    """Set a key of a typed config as given by a word KEY=VALUE."""
    key, equals, _ = word.partition("=")
    if not equals:
        raise InputError(f"{word}: allowed is KEY=VALUE")
    try:
        override = OverridesParser.create().parse_override(word)  # a bare off is text, not false
        if override.is_sweep_override():
            raise InputError(f"{word}: allowed is one value; a list is [in,brackets]")
        OmegaConf.update(cfg, key, override.value(), merge=True)
    except (OmegaConfBaseException, HydraException) as error:
        raise InputError(f"{key}: {str(error).splitlines()[0]}") from None
