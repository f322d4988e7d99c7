"""The training loop of VQ-VAEs and motion networks: steps, checkpoints, validation, log.

A step's randomness only depends on (seed, step). A run that was killed and resumed ends with the same weights
as an uninterrupted run, bit for bit on a CPU. Several processes may train one run together
(memmlp.common.distributed). Only the first process writes files."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from memmlp.common import distributed
from memmlp.common.errors import InputError, RunStopped, TrainingDiverged
from memmlp.common.processes import UsageTimer
from memmlp.common.progress import ProgressCounter, announce, label_progress, notify, show_progress
from memmlp.motion.dataset import MotionDataset
from memmlp.networks import checkpoint, layers
from memmlp.runs.run import Run
from memmlp.training.compute import measure_step
from memmlp.training.optim import Average, Optim


@dataclass(frozen=True)
class StepResult:
    """The results of a training step: the scalar `loss`, its unweighted terms by name, and the samples' clips
    (B,)."""

    loss: Tensor
    terms: dict[str, Tensor]
    clips: Tensor


class TrainingTask:
    """A task for the training loop: a module with a loss and data. Checkpoints hold the module's parameters
    and buffers."""

    module: nn.Module
    dataset: MotionDataset

    def parameter_groups(self) -> list[dict]:
        """Return the optimiser's parameter groups; by default all trainable parameters of the module."""
        return [{"params": [p for p in self.module.parameters() if p.requires_grad]}]

    def step(self, step: int) -> StepResult:
        """Compute the loss of a training step."""
        raise NotImplementedError

    def report(self) -> dict[str, float]:
        """Return further values to log besides the loss terms; by default an empty dict."""
        return {}

    def average_over_draws(self, measure: Callable[[], float]) -> float:
        """Return the expected value of `measure`, a number that depends on random draws of a step."""
        return measure()

    def validate(self) -> dict[str, float]:
        """Compute the metrics on the validation split; {} without validation clips."""
        raise NotImplementedError


def seed_step(seed: int, step: int) -> None:
    """Seed torch's generators for one step."""
    torch.manual_seed(int(np.random.SeedSequence([seed, step]).generate_state(1, np.uint64)[0] >> 1))


ValidationCallback = Callable[[int, dict[str, float]], None]
"""Called after each validation with the step and its values; it may raise to stop the training."""


def train(
    task: TrainingTask,
    settings: Optim,
    run: Run,
    seed: int,
    description: str,
    on_validation: ValidationCallback | None = None,
) -> None:
    """Train for `optim.steps` or `optim.tflop`, starting from the run's checkpoint if there is one. The last
    checkpoint stays in the run's folder. The module is left with the final weights, which may be an average
    over steps, or the best ones on validation. The manifest records the number of steps and the compute.
    `on_validation` is called after each validation. Raises TrainingDiverged if the loss is NaN or infinite,
    RunStopped after a checkpoint if somebody asked for it, and
    InputError if several processes would not give the same result as one process."""
    check_processes(task, settings, description)
    settings = plan_steps(task, settings, run, description)
    optimiser = settings.build(task.parameter_groups())
    average = settings.make_average(task.module, optimiser)
    best = BestWeights(task.module, settings.best_by)
    start, spent = resume(task, optimiser, average, best, run)
    started = time.monotonic() - spent
    if start and distributed.is_first():
        notify(f"{description}: resumes from the last checkpoint, at step {start} of {settings.steps}")
    distributed.copy_from_first(task.module)
    first, usage = distributed.is_first(), UsageTimer()
    with show_progress(description, settings.steps, start, shown=first, unit="steps") as count:
        for step in range(start, settings.steps):
            seed_step(seed, step)
            result = train_step(task, settings, optimiser, step)
            average.update(step + 1)
            validation = record(task, settings, average, run, step + 1, result, count) if first else {}
            if first and (used := usage.read()):
                run.log(step + 1, used | measure_gpu(task.dataset.frames.device), phase="system")
            if validation:
                best.update(step + 1, validation, average)
            stop = step + 1 < settings.steps and must_stop(run, settings, step + 1)
            if stop or (step + 1) % settings.checkpoint_every == 0 or step + 1 == settings.steps:
                save(task, optimiser, average, best, run, step + 1, time.monotonic() - started)
            if validation and on_validation:
                on_validation(step + 1, validation)
            if stop:
                raise RunStopped(run.stop_message)
    if distributed.is_first():
        run.record_seconds("train", time.monotonic() - started)
        run.write_manifest({"best_step": best.step or None})
    average.write_into_module()
    best.write_into_module()


def measure_gpu(device: torch.device) -> dict[str, float]:
    """Return the memory that torch holds on a GPU, GB; {} on a CPU."""
    return {"GPU memory [GB]": torch.cuda.memory_reserved(device) / 1e9} if device.type == "cuda" else {}


def must_stop(run: Run, settings: Optim, step: int) -> bool:
    """Return in all processes whether somebody asked for the run's end. Several processes check only every
    `log_every` steps."""
    if distributed.world_size() > 1 and step % settings.log_every:
        return False
    return distributed.broadcast(distributed.is_first() and run.is_stop_requested)


def plan_steps(task: TrainingTask, settings: Optim, run: Run, description: str) -> Optim:
    """Return settings with whole numbers of steps (`Optim.resolve`), and record them with their compute."""
    compute, spent = measure_step(task, settings), run.manifest.get("prerequisite_tflop", 0.0)
    resolved = settings.resolve(compute.tflop, spent)
    if distributed.is_first():
        if settings.tflop is not None:
            announce(f"{description}: {resolved.steps} steps for optim.tflop={settings.tflop:g}")
        gflop = {"network_gflop": compute.network / 1e9, "optimiser_gflop": compute.optimiser / 1e9}
        total = None if spent is None else spent + resolved.steps * compute.tflop
        run.write_manifest({"steps": resolved.steps, "tflop": total, "step": gflop})
    return resolved


def check_processes(task: TrainingTask, settings: Optim, description: str) -> None:
    """Raise InputError if several processes cannot share a batch with the same result as one process."""
    count = distributed.world_size()
    if settings.batch % count:
        raise InputError(
            f"optim.batch or vqvae.batch={settings.batch}: must be a multiple of the number of processes, "
            f"{count} ({description})"
        )
    if count > 1 and (names := layers.find_batch_dependent_layers(task.module)):
        raise InputError(
            f"{description}: must not use {', '.join(names)} with {count} processes, because the result for "
            "a row would depend on the other rows of its process; for dropout, use "
            "memmlp.networks.layers.Dropout"
        )


def train_step(
    task: TrainingTask, settings: Optim, optimiser: torch.optim.Optimizer, step: int
) -> StepResult:
    """Take one step of the optimiser."""
    task.module.train()
    for group in optimiser.param_groups:
        group.setdefault("initial_lr", group["lr"])
        group["lr"] = group["initial_lr"] * settings.compute_factor(step)
    device = task.dataset.frames.device
    mixed = torch.autocast(device.type, torch.bfloat16) if settings.precision == "bf16" else nullcontext()
    with mixed, distributed.split_batch():
        result = task.step(step)
        gathered = gather_step_result(result)
    check_finite(task, gathered, step)
    optimiser.zero_grad(set_to_none=True)
    result.loss.backward()
    distributed.average_gradients(task.module.parameters())
    if settings.clip_norm:
        torch.nn.utils.clip_grad_norm_(task.module.parameters(), settings.clip_norm)
    optimiser.step()
    return gathered


def gather_step_result(result: StepResult) -> StepResult:
    """Return the result for the whole batch: mean loss and terms of all processes, and all clips."""
    if not distributed.is_batch_split():
        return result
    terms = torch.stack([result.loss, *result.terms.values()])
    loss, *means = distributed.average(terms.detach())
    named = dict(zip(result.terms, means, strict=True))
    return StepResult(loss, named, distributed.gather_rows(result.clips))


def check_finite(task: TrainingTask, result: StepResult, step: int) -> None:
    """Raise TrainingDiverged, naming step, terms and clips, if the loss is NaN or infinite."""
    if torch.isfinite(result.loss):
        return
    bad = [name for name, term in result.terms.items() if not torch.isfinite(term)] or ["weighted sum"]
    names = sorted({task.dataset.names[i] for i in result.clips.tolist()})
    raise TrainingDiverged(
        f"loss is {float(result.loss.detach())} at step {step + 1}, term {', '.join(bad)}; "
        f"clips of the batch: {', '.join(names[:20])}{' ...' if len(names) > 20 else ''}"
    )


def record(
    task: TrainingTask,
    settings: Optim,
    average: Average,
    run: Run,
    step: int,
    result: StepResult,
    count: ProgressCounter,
) -> dict[str, float]:
    """Log and show a finished step; return the validation's values, or {} without a validation."""
    last = step == settings.steps
    if step % settings.log_every == 0 or last:
        loss = float(result.loss.detach())
        terms = {name: float(term.detach()) for name, term in result.terms.items()}
        run.log(step, {"loss": loss, **terms, **task.report()})
        count.set_note(f"loss {loss:.3g}")
    count.advance()
    if step % settings.validate_every == 0 or last:
        if values := validate(task, average):
            run.log(step, values, phase="val")
        return values
    return {}


def validate(task: TrainingTask, average: Average) -> dict[str, float]:
    """Validate the final weights (see Average), and return the task's values."""
    task.module.eval()
    with average.use_average(), label_progress("validation"):
        return task.validate()


def save(
    task: TrainingTask,
    optimiser: torch.optim.Optimizer,
    average: Average,
    best: BestWeights,
    run: Run,
    step: int,
    seconds: float,
) -> None:
    """Write a checkpoint after `step` steps and `seconds` of training; processes other than the first copy
    its weights."""
    distributed.copy_from_first(task.module)
    if not distributed.is_first():
        return
    rates = [group["initial_lr"] for group in optimiser.param_groups]
    tensors = checkpoint.collect_module_tensors("module", task.module)
    tensors |= checkpoint.collect_optimiser_tensors(optimiser) | average.tensors() | best.tensors()
    tensors["rng.torch"] = torch.get_rng_state()
    values = {"step": step, "initial_lr": rates, "seconds": seconds, **best.values()}
    checkpoint.write(run.checkpoint, tensors, values)


def resume(
    task: TrainingTask, optimiser: torch.optim.Optimizer, average: Average, best: BestWeights, run: Run
) -> tuple[int, float]:
    """Load the checkpoint if there is one; return the finished steps, and the seconds of training."""
    state = checkpoint.read(run.checkpoint) if distributed.is_first() and run.checkpoint.exists() else None
    state = distributed.broadcast(state)
    if state is None:
        return 0, 0.0
    tensors, values = state
    checkpoint.load_module("module", task.module, tensors)
    checkpoint.load_optimiser(optimiser, tensors)
    average.load(tensors)
    best.load(tensors, values)
    torch.set_rng_state(tensors["rng.torch"])
    for group, rate in zip(optimiser.param_groups, values["initial_lr"], strict=True):
        group["initial_lr"] = rate
    return values["step"], values["seconds"]


class BestWeights:
    """The weights with the lowest MPJPE of a branch on validation; without a branch, the last weights. A
    checkpoint holds them, too. `step` is that of the kept weights; 0 before the first validation, and without
    a branch."""

    def __init__(self, module: nn.Module, branch: str | None):
        self.module, self.metric = module, f"{branch} MPJPE" if branch else None
        self.step, self.error = 0, math.inf
        self.weights: dict[str, Tensor] = {}

    def update(self, step: int, values: dict[str, float], average: Average) -> None:
        """Keep a copy of the final weights (see Average) if their error is the lowest so far. Raises
        InputError if the branch's error is not among the validation's values."""
        if self.metric is None:
            return
        if self.metric not in values:
            raise InputError(f"optim.best_by: '{self.metric}' is not validated; expected another branch")
        if values[self.metric] < self.error:
            self.step, self.error = step, values[self.metric]
            with average.use_average():
                self.weights = {name: one.detach().clone() for name, one in self.module.state_dict().items()}

    def write_into_module(self) -> None:
        """Write the kept weights into the module. Without kept weights, the module is not changed."""
        if self.weights:
            self.module.load_state_dict(self.weights)

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors for a checkpoint; each name begins with "best."."""
        return {f"best.{name}": one for name, one in self.weights.items()}

    def values(self) -> dict[str, Any]:
        """Return the values for a checkpoint; empty without kept weights."""
        return {"best": [self.step, self.error]} if self.weights else {}

    def load(self, tensors: dict[str, Tensor], values: dict[str, Any]) -> None:
        """Restore the kept weights from a checkpoint."""
        kept = [name for name in tensors if name.startswith("best.")]
        self.weights = {name.removeprefix("best."): tensors[name] for name in kept}
        self.step, self.error = values.get("best", (0, math.inf))
