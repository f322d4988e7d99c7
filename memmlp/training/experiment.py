"""The experiment: a request with the built objects that carry it out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch

from memmlp.deploy.deployment import Deployment
from memmlp.evaluation.evaluation import Evaluation
from memmlp.motion.motion_source import Prepared
from memmlp.networks.architectures import Architecture
from memmlp.runs.loggers.logger import Loggers
from memmlp.runs.run import Run
from memmlp.training.request import RunRequest
from memmlp.training.train_network import NetworkTraining
from memmlp.training.train_refiner import RefinerTraining


class PrerequisiteTraining(Protocol):
    """How to train a run whose weights a later training starts from, such as a VQ-VAE's."""

    @property
    def kind(self) -> str:
        """The kind of the run that the training makes (see `Identity`)."""

    @property
    def description(self) -> str:
        """What the training does, in words."""

    def train(
        self,
        architecture: Architecture,
        data: Prepared,
        prerequisite: Path | None,
        run: Run,
        device: torch.device,
    ) -> dict[str, float]:
        """Train from the weights in `prerequisite`, or resume the run's checkpoint; return errors."""


def kind_alone(kind: str, config: Mapping[str, Any]) -> str:
    """Return the kind as a run's name."""
    return kind


@dataclass(frozen=True)
class Experiment(RunRequest):
    """A request with all that its runs need, as built objects.

    Attributes:
        device: device of training and evaluation.
        architecture: builds the networks.
        prerequisites: how to train the runs that the network builds upon; each builds upon the one before.
        training: how the network is trained.
        evaluation: how the network is evaluated.
        deployment: how the network is exported and timed; None where it is not deployed.
        loggers: show the runs elsewhere, such as in MLflow.
        make_name: makes a readable name for a run from its kind and its config.
        unrefined: the experiment of the network that is refined; None without a refiner.
    """

    device: torch.device
    architecture: Architecture
    prerequisites: tuple[PrerequisiteTraining, ...]
    training: NetworkTraining | RefinerTraining
    evaluation: Evaluation
    deployment: Deployment | None
    loggers: Loggers
    make_name: Callable[[str, Mapping[str, Any]], str] = kind_alone
    unrefined: Experiment | None = None
