"""The training of motion networks, and of the VQ-VAE for their memory (App. A)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor, nn

from memmlp.common import distributed
from memmlp.common.errors import InputError
from memmlp.evaluation import modes
from memmlp.evaluation.metrics import UserMetrics
from memmlp.motion.body import ROTATION, SPARSE_DIM
from memmlp.motion.dataset import MirroredDataset, MotionDataset, WindowSampler
from memmlp.motion.motion_source import PreparedMotion
from memmlp.motion.normalizer import Normalizer
from memmlp.networks import checkpoint
from memmlp.networks.architectures import Architecture
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.vqvae import VQVAE, measure_rotation_error
from memmlp.runs.identity import NETWORK
from memmlp.runs.run import Run
from memmlp.training.loop import StepResult, TrainingTask, ValidationCallback, train
from memmlp.training.losses import Loss
from memmlp.training.optim import Optim
from memmlp.training.rollout import Rollout

VALIDATION_PIECE = 240  # frames, 4 s: validation streams through pieces of clips of this length


@dataclass(frozen=True)
class TrainingJob:
    """The inputs of a training, and the run to train. `prerequisite` is the weights file of the prerequisite
    run, such as a frozen VQ-VAE. `on_validation` is called after each validation."""

    architecture: Architecture
    data: PreparedMotion
    prerequisite: Path | None
    run: Run
    device: torch.device
    on_validation: ValidationCallback | None = None


class Training:
    """The interface of a training. It trains the weights of runs of one `kind` (see `Identity`)."""

    kind: str

    @property
    def description(self) -> str:
        """A short text about the training, for progress messages."""
        return self.kind

    def train(self, job: TrainingJob) -> dict[str, float]:
        """Train, from the run's checkpoint if there is one, and write the weights to the run's folder. Return
        the validation errors of the kept weights; empty in a process that does not validate."""
        raise NotImplementedError


def make_validation(
    data: PreparedMotion, metrics: UserMetrics, device: torch.device, count: int | None = None
) -> Callable[[MotionModel], dict[str, float]]:
    """Return a function that measures a network on `count` evenly spread pieces of the validation clips, or
    all of them; {} without validation clips."""
    if not data.has("val"):
        return lambda network: {}
    pieces = modes.cut_clips(data.open("val").to(device), VALIDATION_PIECE, least=60)
    if count is not None and count < len(pieces):
        pieces = [pieces[i * len(pieces) // count] for i in range(count)]
    return lambda network: modes.measure_stream(network, pieces, metrics)


def write_weights(run: Run, model: nn.Module) -> None:
    """Write the weights of a trained module to its run, in the first process."""
    if distributed.is_first():
        checkpoint.write(run.model, checkpoint.collect_module_tensors("model", model), {})


def read_kept_errors(run: Run) -> dict[str, float]:
    """Return the validation errors of a run's weights; empty in a process that does not validate."""
    return dict(run.kept_validation.values) if run.kept_validation else {}


@dataclass(frozen=True)
class NetworkTraining(Training):
    """The training of a motion network. `loss` makes the loss, given the network's branches. `drawn_by` and
    `shares` are those of WindowSampler. Custom `metrics` are measured at validations. With `mirror`, half of
    the training windows are mirrored."""

    seed: int
    loss: Callable[[frozenset[str]], Loss]
    rollout: Rollout
    optim: Optim
    drawn_by: str
    shares: Mapping[str, float] | None = None
    metrics: UserMetrics = field(default_factory=dict)
    mirror: bool = False
    kind = NETWORK

    @property
    def description(self) -> str:
        """A short text about the training, for progress messages."""
        return f"network: training for {self.optim.length}"

    def train(self, job: TrainingJob) -> dict[str, float]:
        task = self.make_task(job.architecture, job.data, job.prerequisite, job.device)
        train(task, self.optim, job.run, self.seed, "network", job.on_validation)
        write_weights(job.run, task.model)
        return read_kept_errors(job.run)

    def make_task(
        self,
        architecture: Architecture,
        data: PreparedMotion,
        prerequisite: Path | None,
        device: torch.device,
    ) -> MotionTask:
        """Make the task of training a new network; see `train` for the arguments. It seeds torch for the
        initial weights, and restarts the rollout."""
        dataset = data.open("train").to(device)
        torch.manual_seed(self.seed)
        normalizer = architecture.make_normalizer(data.manifest, dataset.frames)
        model = architecture.build_for_training(normalizer, prerequisite).to(device)
        self.rollout.begin(model)
        return MotionTask(
            model,
            self.loss(model.branches).to(device),
            self.rollout.to(device),
            MirroredDataset(dataset) if self.mirror else dataset,
            self.optim,
            self.seed,
            validate=make_validation(data, self.metrics, device, self.optim.validation_pieces),
            drawn_by=self.drawn_by,
            shares=self.shares,
        )


@dataclass(frozen=True)
class PublishedWeights:
    """The weights that a network's authors publish, under the names here.

    Attributes:
        tensors: the network's tensors by name, without the normalizer's.
        statistics: mean and standard deviation (2, 132) of the rotations; None: those of the training clips.
        origin: the record of the origin for the manifest (`memmlp.runs.records.Imported`).
    """

    tensors: Mapping[str, Tensor]
    statistics: Tensor | None
    origin: Mapping[str, str]


@dataclass(frozen=True)
class WeightsImport(NetworkTraining):
    """The import of published weights in place of a training.

    Attributes:
        published: the weights; None if the run exists already.
    """

    published: PublishedWeights | None = None

    @property
    def description(self) -> str:
        """A short text about the import, for progress messages."""
        return "network: importing published weights"

    def train(self, job: TrainingJob) -> dict[str, float]:
        """Write the weights; see Training. Nothing is trained. Raises InputError if a config asks for the
        run, because only `memmlp import-weights` can make it."""
        if self.published is None:
            raise InputError("imported_weights: must be null; use memmlp import-weights instead")
        frames = job.data.open("train").frames
        normalizer = job.architecture.make_normalizer(job.data.manifest, frames)
        if self.published.statistics is not None:
            place = slice(SPARSE_DIM, SPARSE_DIM + ROTATION.stop)
            normalizer.mean[place], normalizer.std[place] = self.published.statistics
        model = job.architecture.build(normalizer, None)
        tensors = checkpoint.collect_module_tensors("model", model)
        tensors |= {f"model.{name}": tensor for name, tensor in self.published.tensors.items()}
        origin = self.published.origin
        text = "{file} (sha256 {sha256}), weights of {source}".format(**origin)
        checkpoint.write(job.run.model, tensors, {"origin": text})
        job.run.write_manifest({"imported": dict(origin)})
        return {}


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
        self.compute_training_outputs, self.compute_loss = model.compute_training_outputs, loss.forward
        if optim.compile:
            self.compute_training_outputs = torch.compile(self.compute_training_outputs)
            self.compute_loss = torch.compile(self.compute_loss)
        self._validate = validate

    def parameter_groups(self) -> list[dict]:
        trained = [p for p in self.model.parameters() if p.requires_grad]
        return [{"params": trained}, *self.loss.weighting.parameter_groups()]

    def step(self, step: int) -> StepResult:
        call = self.rollout.draw(self.model, self.dataset, self.sampler, step)
        motion, state, losses = self.compute_training_outputs(call.sparse, call.state, call.true_frames)
        self.rollout.keep(state)
        members = len(motion) // len(call.true_frames)  # a network may return the motion of several
        truth = call.true_frames[:, -motion.shape[1] :].expand(members, -1, -1, -1).flatten(0, 1)
        sparse, truth = truth[..., :SPARSE_DIM], truth[..., SPARSE_DIM:]
        loss, terms = self.compute_loss(motion, truth, sparse, self.model.normalizer)
        return StepResult(sum(losses.values(), loss), terms | losses, call.clips)

    def average_over_draws(self, measure: Callable[[], float]) -> float:
        return self.rollout.average_over_draws(measure)

    def report(self) -> dict[str, float]:
        return {f"weight_{name}": value for name, value in self.loss.weighting.weights().items()}

    def validate(self) -> dict[str, float]:
        return self._validate(self.model)


@dataclass(frozen=True)
class VQVAETraining(Training):
    """The training of a VQ-VAE. Every epoch uses each training frame once (docs/readings.md, no. 5).
    `data.drawn_by` and the sources' weights have no effect here, so networks with different window sampling
    can share a VQ-VAE. `optim` makes the optimisation, given the number of training frames."""

    seed: int
    optim: Callable[[int], Optim]
    mirror: bool = False
    kind = "vqvae"

    @property
    def description(self) -> str:
        return "VQ-VAE: training, since the network's memory uses its code-vectors"

    def train(self, job: TrainingJob) -> dict[str, float]:
        data, device = job.data, job.device
        dataset = data.open("train").to(device)
        validation = data.open("val").to(device) if data.has("val") else None
        torch.manual_seed(self.seed)
        normalizer = job.architecture.make_normalizer(data.manifest, dataset.frames).to(device)
        model = job.architecture.vqvae().to(device)
        optim = self.optim(len(dataset.frames))
        training = MirroredDataset(dataset) if self.mirror else dataset
        task = VQVAETask(model, normalizer, training, validation, optim, self.seed)
        train(task, optim, job.run, self.seed, "VQ-VAE", job.on_validation)
        write_weights(job.run, model)
        return task.validate()


class VQVAETask(TrainingTask):
    """The training task of a VQ-VAE: Eq. 1 on the reconstructed rotations, and the codebook loss (App. A)."""

    def __init__(
        self,
        model: VQVAE,
        normalizer: Normalizer,
        dataset: MotionDataset,
        validation: MotionDataset | None,
        optim: Optim,
        seed: int,
    ):
        self.model, self.normalizer, self.dataset, self.validation = model, normalizer, dataset, validation
        self.module = model
        self.sampler = WindowSampler(dataset, batch=optim.batch, window=1, seed=seed)
        self.used = torch.zeros(len(model.codebook.vectors))

    def step(self, step: int) -> StepResult:
        clips, end = map(distributed.take_local_rows, self.sampler.draw(step))
        frames = self.normalizer.encode(self.dataset.read_stretches(clips, end, 1))[:, 0]
        terms, indices = self.model.compute_losses(frames, self.normalizer)
        self.used = torch.bincount(distributed.gather_rows(indices), minlength=len(self.used)).float()
        return StepResult(torch.stack(list(terms.values())).sum(), terms, clips)

    def report(self) -> dict[str, float]:
        return {"perplexity": compute_perplexity(self.used)}

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        if self.validation is None:
            return {}
        frames = self.normalizer.encode(self.validation.frames)
        vectors, index = self.model.codebook(self.model.encode(frames))
        used = torch.bincount(index, minlength=len(self.used)).float()
        error = measure_rotation_error(self.model.decoder(vectors), frames, self.normalizer)
        return {"rotation": float(error), "perplexity": compute_perplexity(used)}


def compute_perplexity(counts: Tensor) -> float:
    """Return the perplexity of counts (K,), the exponential of their entropy: see `torch.special.entr`."""
    share = counts / counts.sum().clamp_min(1)
    return float(torch.special.entr(share).sum().exp())
