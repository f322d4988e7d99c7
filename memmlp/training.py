"""The training loop, for VQ-VAE and motion networks alike: steps, checkpoints, validation, records.

A step's randomness comes from (seed, step) alone, so a run that was killed and resumed ends in the same
weights, bit for bit on a CPU, as one that was not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from rich.progress import Progress, TaskID
from torch import Tensor, nn

from memmlp import checkpoint
from memmlp.body import SPARSE_DIM
from memmlp.data.dataset import Frames, WindowSampler
from memmlp.errors import TrainingDiverged
from memmlp.features import Frame
from memmlp.losses import Loss
from memmlp.model import WindowModel
from memmlp.progress import progress
from memmlp.rollout import Rollout
from memmlp.runs import Run
from memmlp.vqvae import VQVAE, rotation_error

SCHEDULES: dict[str, Callable[[float, float, float], float]] = {
    # (progress in [0, 1), final rate / first rate, where the step falls) -> factor
    "step": lambda done, final, drop_at: 1.0 if done < drop_at else final,
    "cosine": lambda done, final, drop_at: final + (1 - final) * 0.5 * (1 + math.cos(math.pi * done)),
    "milestones": lambda done, final, drop_at: 0.2 ** sum(done >= at for at in (0.2, 0.5, 0.7)),
}


@dataclass(frozen=True)
class Optim:
    """How a module is trained.

    Attributes:
        steps, batch: length and windows (or frames) a step.
        lr, final_lr: learning rate at the start and at the end of the schedule.
        schedule: "step" (falls to final_lr at the fraction drop_at), "cosine", or "milestones" (App. A).
        decoupled: AdamW's weight decay; else Adam's.
        clip_norm: largest norm of the gradient, 0 for none.
        precision: "fp32" or "bf16" (autocast). compile: torch.compile the model's call.
    """

    steps: int
    batch: int
    lr: float
    final_lr: float = 0.0
    schedule: str = "step"
    drop_at: float = 0.75
    weight_decay: float = 1e-4
    betas: tuple[float, float] = (0.9, 0.999)
    decoupled: bool = True
    clip_norm: float = 0.0
    precision: str = "fp32"
    compile: bool = False
    checkpoint_every: int = 500
    validate_every: int = 1000
    log_every: int = 50

    def factor(self, step: int) -> float:
        """The learning rate at a step over the first one."""
        return SCHEDULES[self.schedule](step / self.steps, self.final_lr / self.lr, self.drop_at)

    def build(self, groups: list[dict]) -> torch.optim.Optimizer:
        """The optimiser over parameter groups; a group's own `lr` and `weight_decay` win."""
        kind = torch.optim.AdamW if self.decoupled else torch.optim.Adam
        return kind(groups, lr=self.lr, weight_decay=self.weight_decay, betas=self.betas)


def vqvae_optim(
    steps: int,
    batch: int,
    lr: float,
    weight_decay: float,
    checkpoint_every: int = Optim.checkpoint_every,
    log_every: int = Optim.log_every,
) -> Optim:
    """How a VQ-VAE is trained: Adam, its rate times 0.2 at 20, 50 and 70 % of the steps (App. A)."""
    return Optim(
        steps=steps,
        batch=batch,
        lr=lr,
        schedule="milestones",
        weight_decay=weight_decay,
        betas=(0.9, 0.99),
        decoupled=False,
        checkpoint_every=checkpoint_every,
        validate_every=steps,
        log_every=log_every,
    )


@dataclass(frozen=True)
class StepResult:
    """The loss of a step, its terms by name, and the clips (B,) that its batch came from."""

    loss: Tensor
    terms: dict[str, Tensor]
    clips: Tensor


class Task(Protocol):
    """What is trained."""

    @property
    def module(self) -> nn.Module:
        """All that a checkpoint must carry."""

    @property
    def frames(self) -> Frames:
        """The training split."""

    def parameter_groups(self) -> list[dict]:
        """For the optimiser."""

    def step(self, step: int) -> StepResult:
        """The loss of a training step."""

    def report(self) -> dict[str, float]:
        """Values worth logging beside the loss terms."""

    def validate(self) -> dict[str, float]:
        """Metrics on the validation split."""


class VQVAETask:
    """Eq. 1 on the reconstructed rotations plus the codebook's loss (App. A)."""

    def __init__(
        self, model: VQVAE, frame: Frame, frames: Frames, validation: Frames, optim: Optim, seed: int
    ):
        self.model, self.frame, self.frames, self.validation = model, frame, frames, validation
        self.module: nn.Module = model
        self.sampler = WindowSampler(frames, batch=optim.batch, window=1, seed=seed)
        self.used = torch.zeros(len(model.codebook.vectors))

    def parameter_groups(self) -> list[dict]:
        """All parameters."""
        return [{"params": [p for p in self.model.parameters() if p.requires_grad]}]

    def step(self, step: int) -> StepResult:
        """The loss on a batch of single frames."""
        clips, end = self.sampler.draw(step)
        frames = self.frame.encode(self.frames.segments(clips, end, 1))[:, 0]
        terms, indices = self.model.loss_terms(frames, self.frame)
        self.used = torch.bincount(indices, minlength=len(self.used)).float()
        return StepResult(torch.stack(list(terms.values())).sum(), terms, clips)

    def report(self) -> dict[str, float]:
        """How many codes are used, as the exponential of their entropy."""
        return {"perplexity": perplexity(self.used)}

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Eq. 1 and the perplexity on validation frames."""
        frames = self.frame.encode(self.validation.frames)
        vectors, index = self.model.codebook(self.model.encoder(frames))
        used = torch.bincount(index, minlength=len(self.used)).float()
        error = rotation_error(self.model.decoder(vectors), frames, self.frame)
        return {"rotation": float(error), "perplexity": perplexity(used)}


class MotionTask:
    """A motion network under its loss, its history made by the rollout."""

    def __init__(
        self,
        model: WindowModel,
        loss: Loss,
        rollout: Rollout,
        frames: Frames,
        optim: Optim,
        seed: int,
        validate: Callable[[WindowModel], dict[str, float]],
        weighting: str = "frames",
    ):
        self.model, self.loss, self.rollout, self.frames = model, loss, rollout, frames
        self.module: nn.Module = nn.ModuleDict({"model": model, "loss": loss, "rollout": rollout})
        self.sampler = WindowSampler(frames, optim.batch, model.frames, seed, weighting)
        self.learn = torch.compile(model.learn) if optim.compile else model.learn
        self._validate = validate

    def parameter_groups(self) -> list[dict]:
        """The model's trainable parameters, and the loss' own."""
        trained = [p for p in self.model.parameters() if p.requires_grad]
        return [{"params": trained}, *self.loss.weighting.parameter_groups()]

    def step(self, step: int) -> StepResult:
        """The loss of one training call."""
        call = self.rollout.draw(self.model, self.frames, self.sampler, step)
        motion, state = self.learn(call.sparse, call.state, call.truth)
        self.rollout.keep(state)
        true = call.truth[:, -motion.shape[1] :]
        loss, terms = self.loss(motion, true[..., SPARSE_DIM:], true[..., :SPARSE_DIM], self.model.frame)
        own = self.model.terms(call.truth)
        return StepResult(sum(own.values(), loss), terms | own, call.clips)

    def report(self) -> dict[str, float]:
        """The weights of the loss terms."""
        return {f"weight_{name}": value for name, value in self.loss.weighting.weights().items()}

    def validate(self) -> dict[str, float]:
        """Stream-mode metrics on the validation split."""
        return self._validate(self.model)


def perplexity(counts: Tensor) -> float:
    """Exponential of the entropy of counts (K,): K where all are used alike, 1 where one is."""
    share = counts / counts.sum().clamp_min(1)
    return float(torch.special.entr(share).sum().exp())


def seed_step(seed: int, step: int) -> None:
    """Seed torch for one step."""
    torch.manual_seed(int(np.random.SeedSequence([seed, step]).generate_state(1, np.uint64)[0] >> 1))


Watch = Callable[[int, dict[str, float]], None]


def unwatched(step: int, values: dict[str, float]) -> None:
    """Lets every run go on."""


def train(task: Task, optim: Optim, run: Run, seed: int, description: str, watch: Watch = unwatched) -> None:
    """Train to `optim.steps`, from the run's checkpoint where there is one, and leave the last checkpoint.

    `watch` is called after each validation with the step and its values, and may raise to stop.
    Raises TrainingDiverged, naming step, term and clips, where a term is NaN or Inf.
    """
    optimiser = optim.build(task.parameter_groups())
    start = resume(task, optimiser, run) if run.checkpoint.exists() else 0
    with progress() as bar:
        row = bar.add_task(description, total=optim.steps, completed=start, note="")
        for step in range(start, optim.steps):
            seed_step(seed, step)
            result = train_step(task, optim, optimiser, step)
            validation = record(task, optim, run, step + 1, result, bar, row)
            if (step + 1) % optim.checkpoint_every == 0 or step + 1 == optim.steps:
                save(task, optimiser, run, step + 1)
            if validation:
                watch(step + 1, validation)


def train_step(task: Task, optim: Optim, optimiser: torch.optim.Optimizer, step: int) -> StepResult:
    """One step of the optimiser."""
    task.module.train()
    for group in optimiser.param_groups:
        group.setdefault("initial_lr", group["lr"])
        group["lr"] = group["initial_lr"] * optim.factor(step)
    device = task.frames.frames.device
    mixed = torch.autocast(device.type, torch.bfloat16) if optim.precision == "bf16" else nullcontext()
    with mixed:
        result = task.step(step)
    check_finite(task, result, step)
    optimiser.zero_grad(set_to_none=True)
    result.loss.backward()
    if optim.clip_norm:
        torch.nn.utils.clip_grad_norm_(task.module.parameters(), optim.clip_norm)
    optimiser.step()
    return result


def check_finite(task: Task, result: StepResult, step: int) -> None:
    """Stop where the loss is no number."""
    if torch.isfinite(result.loss):
        return
    bad = [name for name, term in result.terms.items() if not torch.isfinite(term)] or ["weighted sum"]
    names = sorted({task.frames.names[i] for i in result.clips.tolist()})
    raise TrainingDiverged(
        f"loss is {float(result.loss.detach())} at step {step + 1}, term {', '.join(bad)}; "
        f"clips of the batch: {', '.join(names[:20])}{' ...' if len(names) > 20 else ''}"
    )


def record(
    task: Task, optim: Optim, run: Run, step: int, result: StepResult, bar: Progress, row: TaskID
) -> dict[str, float]:
    """Log and show a finished step, and validate where it is time; the validation's values, or none."""
    last = step == optim.steps
    bar.advance(row)
    if step % optim.log_every == 0 or last:
        loss = float(result.loss.detach())
        terms = {name: float(term.detach()) for name, term in result.terms.items()}
        run.log(step, {"loss": loss, **terms, **task.report()})
        bar.update(row, note=f"loss {loss:.3g}")
    if step % optim.validate_every == 0 or last:
        task.module.eval()
        values = task.validate()
        run.log(step, values, phase="val")
        return values
    return {}


def save(task: Task, optimiser: torch.optim.Optimizer, run: Run, step: int) -> None:
    """Write all that a later process needs to go on after `step` steps."""
    rates = [group["initial_lr"] for group in optimiser.param_groups]
    tensors = checkpoint.module_tensors("module", task.module) | checkpoint.optimiser_tensors(optimiser)
    tensors["rng.torch"] = torch.get_rng_state()
    checkpoint.write(run.checkpoint, tensors, {"step": step, "initial_lr": rates})


def resume(task: Task, optimiser: torch.optim.Optimizer, run: Run) -> int:
    """Put the run's checkpoint back; the number of steps done."""
    tensors, values = checkpoint.read(run.checkpoint)
    checkpoint.load_module("module", task.module, tensors)
    checkpoint.load_optimiser(optimiser, tensors)
    torch.set_rng_state(tensors["rng.torch"])
    for group, rate in zip(optimiser.param_groups, values["initial_lr"], strict=True):
        group["initial_lr"] = rate
    return values["step"]
