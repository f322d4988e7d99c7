"""The experiment: its data, its network, how each stage is done, and the identities of all of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from memmlp.deploy.deployment import Deployment
from memmlp.evaluation.evaluation import Evaluation
from memmlp.motion.preparing.source import MotionSource
from memmlp.networks.architecture import VQVAE_SETTINGS, Architecture
from memmlp.runs.identity import Identity, deployment_id, evaluation_id
from memmlp.tracking.feed import Tracking
from memmlp.training.network import NetworkTraining
from memmlp.training.refiner import RefinerTraining
from memmlp.training.vqvae import VQVAETraining


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
        data: the motion.
        architecture: builds the networks.
        vqvae: how a frozen VQ-VAE is trained.
        training: how the network is trained.
        evaluation: how it is evaluated.
        deployment: how it is exported and timed; None where it is not to be.
        predictions: folder for predictions of the test clips; None for no such files.
        tracking: shows runs elsewhere.
        called: makes a name that people can read, of the config of a run and the word for its kind.
        base: the experiment of the network that a refiner stands behind; None without a refiner.
    """

    config: dict[str, Any]
    outputs: Path
    device: torch.device
    force: bool
    data: MotionSource
    architecture: Architecture
    vqvae: VQVAETraining
    training: NetworkTraining | RefinerTraining
    evaluation: Evaluation
    deployment: Deployment | None
    predictions: Path | None
    tracking: Tracking
    called: Callable[[str, Mapping[str, Any]], str] = unnamed
    base: Experiment | None = None

    @property
    def evaluations(self) -> dict[str, str]:
        """The identity of the evaluation in each mode."""
        return {mode: evaluation_id(self.config, mode, self.data.grouped) for mode in self.evaluation.modes}

    @property
    def deployments(self) -> dict[str, Deployment]:
        """The deployment by its identity; empty where none is wanted."""
        return {deployment_id(self.config): self.deployment} if self.deployment else {}

    @property
    def stages(self) -> tuple[str, ...]:
        """The identities of the evaluations and the deployment."""
        return (*self.evaluations.values(), *self.deployments)

    def vqvae_identity(self, data: str) -> Identity | None:
        """Return the identity of the VQ-VAE's run on data of that digest; None if the network uses none."""
        return Identity("vqvae", self.vqvae.config, data) if self.architecture.uses_codes else None

    def identity(self, data: str) -> Identity:
        """Return the identity of the network's run on data of that digest."""
        # The identity of a frozen VQ-VAE's run covers its config. A joint VQ-VAE is trained with the network,
        # so only the keys of its architecture act.
        own = {key: value for key, value in self.config.items() if key != "vqvae"}
        if self.architecture.trains_codes:
            own["vqvae"] = {key: self.config["vqvae"][key] for key in VQVAE_SETTINGS}
        above = self.base.identity(data) if self.base else self.vqvae_identity(data)
        return Identity("memmlp", own, data, above)
