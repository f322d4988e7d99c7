"""The stage that trains a motion network."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import nn

from memmlp.common import distributed
from memmlp.evaluation import modes
from memmlp.evaluation.metrics import UserMetrics
from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.dataset import MirroredDataset, MotionDataset, WindowSampler
from memmlp.motion.motion_source import Prepared
from memmlp.networks import checkpoint
from memmlp.networks.architectures import Architecture
from memmlp.networks.motion_model import MotionModel
from memmlp.runs.run import Run
from memmlp.training.loop import StepResult, TrainingTask, ValidationCallback, train
from memmlp.training.losses import Loss
from memmlp.training.optim import Optim
from memmlp.training.rollout import Rollout

VALIDATION_PIECE = 240  # frames, 4 s: validation streams through pieces of clips of this length


@dataclass(frozen=True)
class NetworkTraining:
    """How a motion network is trained.

    Attributes:
        seed: seed of the weights, batches and rollouts.
        loss: makes the loss, given the network's branches.
        rollout: makes the history that the network is trained on.
        optim: steps, learning rates and intervals.
        drawn_by: how training windows are drawn, "frames" or "clips" (see WindowSampler).
        shares: the share of windows drawn from each source (see WindowSampler).
        metrics: custom metrics, measured at validations.
        mirror: whether half of the training windows are mirrored (see MirroredDataset).
    """

    seed: int
    loss: Callable[[frozenset[str]], Loss]
    rollout: Rollout
    optim: Optim
    drawn_by: str
    shares: Mapping[str, float] | None = None
    metrics: UserMetrics = field(default_factory=dict)
    mirror: bool = False

    def train(
        self,
        architecture: Architecture,
        data: Prepared,
        prerequisite: Path | None,
        run: Run,
        device: torch.device,
        on_validation: ValidationCallback | None = None,
    ) -> MotionModel:
        """Train a network, from the run's checkpoint if there is one, and write the network's weights.

        Args:
            architecture: builds the network.
            data: the prepared motion.
            prerequisite: file of the prerequisite run's weights, such as a frozen VQ-VAE's, or None.
            run: the run whose folder takes checkpoints, log and weights.
            device: the device to train on.
            on_validation: called after each validation; see `memmlp.training.loop.train`.

        Returns:
            The trained network in evaluation mode.
        """
        task = self.task(architecture, data, prerequisite, device)
        train(task, self.optim, run, self.seed, "network", on_validation)
        if distributed.is_first():
            checkpoint.write(run.model, checkpoint.module_tensors("model", task.model), {})
        return task.model.eval()

    def task(
        self, architecture: Architecture, data: Prepared, prerequisite: Path | None, device: torch.device
    ) -> MotionTask:
        """Make the task of training an untrained network; for the arguments see `train`.

        It seeds torch for the first weights, and restarts the rollout.
        """
        dataset = data.open("train").to(device)
        torch.manual_seed(self.seed)
        normalizer = architecture.make_normalizer(data.manifest, dataset.frames)
        model = architecture.build_for_training(normalizer, prerequisite).to(device)
        self.rollout.begin(model)
        pieces = modes.chunks(data.open("val").to(device), VALIDATION_PIECE, least=60)
        return MotionTask(
            model,
            self.loss(model.branches).to(device),
            self.rollout.to(device),
            MirroredDataset(dataset) if self.mirror else dataset,
            self.optim,
            self.seed,
            validate=lambda network: modes.quick_stream(network, pieces, self.metrics),
            drawn_by=self.drawn_by,
            shares=self.shares,
        )


class MotionTask(TrainingTask):
    """The training task of a motion network: its loss, on the history that the rollout makes."""

    def __init__(
        self,
        model: MotionModel,
        loss: Loss,
        rollout: Rollout,
        dataset: MotionDataset,
        optim: Optim,
        seed: int,
        validate: Callable[[MotionModel], dict[str, float]],
        drawn_by: str = "frames",
        shares: Mapping[str, float] | None = None,
    ):
        self.model, self.loss, self.rollout, self.dataset = model, loss, rollout, dataset
        self.module = nn.ModuleDict({"model": model, "loss": loss, "rollout": rollout})
        self.sampler = WindowSampler(dataset, optim.batch, model.frames, seed, drawn_by, shares)
        self.training_call = torch.compile(model.training_call) if optim.compile else model.training_call
        self._validate = validate

    def parameter_groups(self) -> list[dict]:
        """Return the model's trainable parameters and those of the loss weighting."""
        trained = [p for p in self.model.parameters() if p.requires_grad]
        return [{"params": trained}, *self.loss.weighting.parameter_groups()]

    def step(self, step: int) -> StepResult:
        """Compute the loss of one training call."""
        call = self.rollout.draw(self.model, self.dataset, self.sampler, step)
        motion, state, own = self.training_call(call.sparse, call.state, call.true_frames)
        self.rollout.keep(state)
        members = len(motion) // len(call.true_frames)  # a network may return the motion of several
        true = call.true_frames[:, -motion.shape[1] :].repeat(members, 1, 1)
        loss, terms = self.loss(motion, true[..., SPARSE_DIM:], true[..., :SPARSE_DIM], self.model.normalizer)
        return StepResult(sum(own.values(), loss), terms | own, call.clips)

    def report(self) -> dict[str, float]:
        """Return the weights of the loss terms."""
        return {f"weight_{name}": value for name, value in self.loss.weighting.weights().items()}

    def validate(self) -> dict[str, float]:
        """Compute the stream-mode metrics on the validation part."""
        return self._validate(self.model)
