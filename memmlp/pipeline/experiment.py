"""The experiment: its data, its network, how each stage is done, and the identities of the stages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch

from memmlp.deploy.deployment import Deployment
from memmlp.evaluation.evaluation import Evaluation
from memmlp.experiment_tracking.follower_pipe import Loggers
from memmlp.motion.motion_source import MotionSource, Prepared
from memmlp.networks.architectures import VQVAE_SETTINGS, Architecture
from memmlp.runs.identity import NETWORK, Identity, deployment_id, evaluation_id
from memmlp.runs.run import Run
from memmlp.training.train_network import NetworkTraining
from memmlp.training.train_refiner import RefinerTraining


class UpstreamTraining(Protocol):
    """How to train a run whose weights a later training starts from, such as a VQ-VAE's."""

    @property
    def kind(self) -> str:
        """The kind of the run that the training makes (see `Identity`)."""

    @property
    def config(self) -> dict[str, Any]:
        """The part of the resolved config that determines the training's result."""

    @property
    def description(self) -> str:
        """What the training does, in words."""

    def train(
        self,
        architecture: Architecture,
        data: Prepared,
        upstream: Path | None,
        run: Run,
        device: torch.device,
    ) -> dict[str, float]:
        """Train upon the weights in `upstream`, from the run's checkpoint if there is one; return errors."""


def unnamed(kind: str, config: Mapping[str, Any]) -> str:
    """Return the kind alone as a run's name."""
    return kind


@dataclass(frozen=True)
class Experiment:
    """All that a run needs, as built objects.

    Attributes:
        config: the resolved config that the objects were built from.
        outputs: folder of runs and caches.
        device: device of training and evaluation.
        force: whether a finished run is made again.
        motion: the source of the motion.
        architecture: builds the networks.
        upstream: how to train the runs that the network builds upon; each builds upon the one before.
        training: how the network is trained.
        evaluation: how the network is evaluated.
        deployment: how the network is exported and timed; None where it is not deployed.
        predictions: folder for predictions of the test clips; None to write none.
        loggers: show the runs elsewhere, such as in MLflow.
        called: makes a readable name for a run from the word for its kind and its config.
        unrefined: the experiment of the network that is refined; None without a refiner.
    """

    config: dict[str, Any]
    outputs: Path
    device: torch.device
    force: bool
    motion: MotionSource
    architecture: Architecture
    upstream: tuple[UpstreamTraining, ...]
    training: NetworkTraining | RefinerTraining
    evaluation: Evaluation
    deployment: Deployment | None
    predictions: Path | None
    loggers: Loggers
    called: Callable[[str, Mapping[str, Any]], str] = unnamed
    unrefined: Experiment | None = None

    @property
    def evaluations(self) -> dict[str, str]:
        """The identity of the evaluation, by mode."""
        groups = self.motion.groups_digest
        return {mode: evaluation_id(self.config, mode, groups) for mode in self.evaluation.modes}

    @property
    def deployments(self) -> dict[str, Deployment]:
        """The deployment by its identity; empty if none is wanted."""
        return {deployment_id(self.config): self.deployment} if self.deployment else {}

    @property
    def stage_ids(self) -> tuple[str, ...]:
        """The identities of the stages after training: the evaluations and the deployment."""
        return (*self.evaluations.values(), *self.deployments)

    def upstream_identities(self, data_digest: str) -> list[Identity]:
        """Return the identities of the runs upstream, in order, given the digest of the data."""
        found: list[Identity] = []
        for training in self.upstream:
            found.append(Identity(training.kind, training.config, data_digest, found[-1] if found else None))
        return found

    def identity(self, data_digest: str) -> Identity:
        """Return the identity of the network's run, given the digest of the data."""
        # The identity of a frozen VQ-VAE's run covers its config. A joint VQ-VAE is trained with the network,
        # so only the keys of its architecture act.
        own = {key: value for key, value in self.config.items() if key != "vqvae"}
        if self.architecture.trains_codes:
            own["vqvae"] = {key: self.config["vqvae"][key] for key in VQVAE_SETTINGS}
        if self.unrefined:
            return Identity(NETWORK, own, data_digest, self.unrefined.identity(data_digest))
        upstream = self.upstream_identities(data_digest)
        return Identity(NETWORK, own, data_digest, upstream[-1] if upstream else None)
