"""What an experiment is: its data, its network, how each stage is done, and who each of them is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from memmlp.deploy.deployment import Deployment
from memmlp.evaluation.evaluation import Evaluation
from memmlp.motion.source import MotionSource
from memmlp.networks.architecture import VQVAE_SETTINGS, Architecture
from memmlp.runs.identity import Identity, deployment_id, evaluation_id
from memmlp.runs.tracking import Tracking
from memmlp.training.network import NetworkTraining
from memmlp.training.vqvae import VQVAETraining


@dataclass(frozen=True)
class Experiment:
    """All that a run needs, as built objects; `config` is the record of where they came from.

    Attributes:
        outputs: folder of runs and caches. device: of training and evaluation.
        force: whether a run that was made is made again.
        data: the motion. architecture: builds the networks.
        vqvae, training, evaluation, deployment: how the stages are done.
        predictions: folder for the test clips' predictions, where they are wanted.
        tracking: shows finished runs elsewhere.
    """

    config: dict[str, Any]
    outputs: Path
    device: torch.device
    force: bool
    data: MotionSource
    architecture: Architecture
    vqvae: VQVAETraining
    training: NetworkTraining
    evaluation: Evaluation
    deployment: Deployment
    predictions: Path | None
    tracking: Tracking

    @property
    def evaluations(self) -> dict[str, str]:
        """The identity of the evaluation in each of the modes."""
        return {mode: evaluation_id(self.config, mode) for mode in self.evaluation.modes}

    @property
    def deployed(self) -> str:
        """The identity of the deployment."""
        return deployment_id(self.config)

    @property
    def stages(self) -> tuple[str, ...]:
        """The identities of all that is made of the trained network."""
        return (*self.evaluations.values(), self.deployed)

    def vqvae_identity(self, data: str) -> Identity | None:
        """The identity of the VQ-VAE's run on data of that digest, where the network uses a frozen one."""
        return Identity("vqvae", self.vqvae.config, data) if self.architecture.uses_codes else None

    def identity(self, data: str) -> Identity:
        """The identity of the network's run on data of that digest."""
        # A frozen VQ-VAE's own identity stands for its config; of a joint one some keys act nowhere.
        own = {key: value for key, value in self.config.items() if key != "vqvae"}
        if self.architecture.trains_codes:
            own["vqvae"] = {key: self.config["vqvae"][key] for key in VQVAE_SETTINGS}
        return Identity("memmlp", own, data, self.vqvae_identity(data))
