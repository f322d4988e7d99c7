"""The training of a refiner, on the motion that a trained network streams."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.evaluation import modes
from memmlp.evaluation.metrics import UserMetrics
from memmlp.motion.body import HANDS, HEAD, ROOT, ROTATION, SPARSE_DIM
from memmlp.motion.dataset import MirroredDataset, MotionDataset, WindowSampler
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.refiner import HIDDEN, RefinedModel, SAGERefinerSettings
from memmlp.training.loop import StepResult, TrainingTask, train
from memmlp.training.losses import FixedWeights, Loss, Terms, TermsLoss
from memmlp.training.losses.terms import Comparison, measure_jerk
from memmlp.training.optim import Optim
from memmlp.training.train_network import (
    Training,
    TrainingJob,
    make_validation,
    read_kept_errors,
    write_weights,
)

STREAMS_TOGETHER = 64  # pieces that the network streams through side by side


class SAGERefinerLoss(Loss):
    """The loss of SAGE-Net's refiner (CVPR 2024, released code), dominated by rotation velocities. Errors of
    6D rotations, and of rotation changes over one and three frames, are smooth L1 over all components.
    Positions come from forward kinematics with the pelvis at the origin, for head and hands with the head on
    its tracker."""

    def __init__(self) -> None:
        super().__init__()
        weights = {"rotation_all": 0.01, "rotation_velocity": 60.0, "rotation_velocity_3": 20.0}
        weights |= {"position_from_pelvis": 0.01, "trackers": 0.01, "jerk": 0.03}
        self.weighting = FixedWeights(weights)

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        error, pair = (motion - truth)[..., ROTATION], Comparison(motion, truth, sparse, normalizer)
        true, rooted = pair.true_positions, pair.predicted.global_pose[1]
        return {
            "rotation_all": _smooth_l1(error),
            "rotation_velocity": _smooth_l1(error.diff(dim=1)),
            "rotation_velocity_3": _smooth_l1(error[:, ::3].diff(dim=1)),
            "position_from_pelvis": (rooted - (true - true[..., ROOT : ROOT + 1, :])).norm(dim=-1).mean(),
            "trackers": _smooth_l1((pair.positions - true)[..., [HEAD, *HANDS], :]),
            "jerk": measure_jerk(rooted),
        }


def _smooth_l1(error: Tensor) -> Tensor:
    return F.smooth_l1_loss(error, error.new_zeros(()).expand_as(error))


JOINT_LOSS_WEIGHTS: dict[str, Any] = dict.fromkeys(
    ("orientation", "rotation", "world_position", "hand"), 0.01
)
JOINT_LOSS_WEIGHTS |= {"velocity": 60.0, "velocity_3": 20.0, "jerk": 0.03}
"""Weights of the loss that compares joint movements, as in SAGE-Net's loss."""

LOSSES: dict[str, Callable[[], Loss]] = {
    "rotations": SAGERefinerLoss,
    "joints": partial(TermsLoss, "smooth", **JOINT_LOSS_WEIGHTS),
}
"""A refiner's losses, by the quantity with the compared movement."""


@dataclass(frozen=True)
class RefinerTraining(Training):
    """The training of a refiner on batches of pieces, of which half are mirrored with `mirror`. `drawn_by`
    and `shares` are those of WindowSampler. Custom `metrics` are measured at validations."""

    seed: int
    refiner: SAGERefinerSettings
    optim: Optim
    drawn_by: str
    shares: Mapping[str, float] | None = None
    mirror: bool = False
    metrics: UserMetrics = field(default_factory=dict)

    @property
    def description(self) -> str:
        """A short text about the training, for progress messages."""
        return f"refiner: training for {self.optim.length}"

    def train(self, job: TrainingJob) -> dict[str, float]:
        assert job.prerequisite is not None
        plain = job.data.open("train").to(job.device)
        dataset = MirroredDataset(plain) if self.mirror else plain
        finished = replace(job.architecture, refiner=None).load(job.prerequisite)
        finished = finished.to(job.device).requires_grad_(False)
        torch.manual_seed(self.seed)
        model = self.refiner.build(finished).to(job.device)
        validate = make_validation(job.data, self.metrics, job.device, self.optim.validation_pieces)
        task = RefinerTask(
            model,
            LOSSES[self.refiner.velocities](),
            dataset,
            self.draw_pieces(dataset),
            self.optim,
            validate=lambda: validate(model.eval()),
        )
        train(task, self.optim, job.run, self.seed, "refiner", job.on_validation)
        finished.requires_grad_(True)
        write_weights(job.run, model)
        return read_kept_errors(job.run)

    def draw_pieces(self, dataset: MotionDataset) -> tuple[Tensor, Tensor]:
        """Draw the pieces: frames (P, n, 252), and the clip index of each piece (P,)."""
        pieces = WindowSampler(
            dataset, self.refiner.pieces, self.refiner.frames, self.seed, self.drawn_by, self.shares
        )
        clips, end = pieces.draw(0)
        return dataset.read_stretches(clips, end, self.refiner.frames), clips


class RefinerTask(TrainingTask):
    """The training task of a refiner: its loss on pieces that the network streams beforehand."""

    def __init__(
        self,
        model: RefinedModel,
        loss: Loss,
        dataset: MotionDataset,
        pieces: tuple[Tensor, Tensor],
        optim: Optim,
        validate: Callable[[], dict[str, float]],
    ):
        self.model, self.loss, self.dataset, self.batch = model, loss, dataset, optim.batch
        self.frames, self.clips = pieces
        self.module = nn.ModuleDict({"layers": model.layers, "head": model.head})
        model.network.eval()
        streamed = modes.predict(model.network, list(self.frames), "stream", STREAMS_TOGETHER)
        self.streamed, self._validate = torch.stack(streamed), validate

    def step(self, step: int) -> StepResult:
        drawn = torch.randint(len(self.frames), (self.batch,)).to(self.frames.device)
        sparse, truth = self.frames[drawn].split([SPARSE_DIM, self.frames.shape[-1] - SPARSE_DIM], -1)
        hidden = self.model.initial_state(len(drawn))[HIDDEN]
        motion, _ = self.model.refine(self.streamed[drawn], sparse, hidden)
        loss, terms = self.loss(motion, truth, sparse, self.model.normalizer)
        return StepResult(loss, terms, self.clips[drawn])

    def validate(self) -> dict[str, float]:
        return self._validate()
