"""Time a training step on one thread of the CPU, and its matrix products alone.

Run `python benchmarks/training_step.py OVERRIDES`, with the overrides of `memmlp train`.
"""

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from memmlp.cli.options import config_dir_option, plugins_option
from memmlp.common.errors import InputError
from memmlp.config.build import build_experiment
from memmlp.config.compose import compose_config
from memmlp.motion.geometry import limit_to_one_thread
from memmlp.networks import checkpoint
from memmlp.training.loop import TrainingTask, seed_step, train_step
from memmlp.training.optim import Optim
from memmlp.training.run_stages import make_prerequisites
from memmlp.training.train_network import NetworkTraining

WARM_UP = 3  # steps before the first round; torch.compile works in the first one


class ProductRecorder(TorchDispatchMode):
    """A context that records its matrix products: the `calls` that torch's FLOP counter counts, with
    arguments, in order, and their `flops`."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[Callable[..., Any], Sequence[Any], Mapping[str, Any]]] = []
        self.flops = 0

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        if count := flop_registry.get(func.overloadpacket):
            self.calls.append((func, args, kwargs or {}))
            self.flops += count(*args, **(kwargs or {}), out_val=result)
        return result

    @torch.no_grad()
    def replay(self) -> None:
        """Compute the recorded products again, with the same tensors."""
        for func, args, kwargs in self.calls:
            func(*args, **kwargs)


@dataclass(frozen=True)
class StepCost:
    """The processor time of a training step on one thread: milliseconds per step and of its matrix products
    alone in each round (rounds,), FLOPs of these products, and torch's functions, slowest first (name,
    milliseconds and calls per step; empty unless profiled)."""

    step_ms: np.ndarray
    product_ms: np.ndarray
    flops: int
    kernels: list[tuple[str, float, float]]

    @property
    def ratios(self) -> np.ndarray:
        """The ratio of step and products in each round (rounds,)."""
        return self.step_ms / self.product_ms


def measure_step_cost(
    task: TrainingTask, optim: Optim, rounds: int, steps: int, with_kernels: bool = False
) -> StepCost:
    """Measure the processor time of training steps on one thread of the CPU. Each of the `rounds` times some
    steps, then as many replays of one step's products; the median of a round counts."""
    optimiser = optim.build(task.parameter_groups())
    average = optim.make_average(task.module, optimiser)
    done = 0

    def step() -> None:
        nonlocal done
        seed_step(0, done)
        train_step(task, optim, optimiser, done)
        done += 1
        average.update(done)

    with limit_to_one_thread():
        for _ in range(WARM_UP):
            step()
        with ProductRecorder() as recorder, torch.compiler.set_stance("force_eager"):
            step()
        times = [
            [np.median([time_call(call) for _ in range(steps)]) for call in (step, recorder.replay)]
            for _ in range(rounds)
        ]
        kernels = profile_kernels(step, steps) if with_kernels else []
    step_ms, product_ms = 1000 * np.array(times).T
    return StepCost(step_ms, product_ms, recorder.flops, kernels)


def profile_kernels(call: Callable[[], None], times: int) -> list[tuple[str, float, float]]:
    """Return torch's functions in some calls, the slowest first: name, milliseconds and calls per call."""
    with profile(activities=[ProfilerActivity.CPU]) as profiler:
        for _ in range(times):
            call()
    found = sorted(profiler.key_averages(), key=lambda one: one.self_cpu_time_total, reverse=True)
    return [(one.key, one.self_cpu_time_total / 1000 / times, one.count / times) for one in found]


def time_call(call: Callable[[], None]) -> float:
    """Return the seconds of processor time that a call takes in this thread."""
    started = time.thread_time()
    call()
    return time.thread_time() - started


@click.command(context_settings={"show_default": True})
@click.option("--rounds", default=5, type=click.IntRange(1), help="Number of timed rounds.")
@click.option("--steps", default=10, type=click.IntRange(1), help="Number of steps per round.")
@click.option("--profile", "kernels", is_flag=True, help="Also print the slowest functions of torch.")
@click.argument("overrides", nargs=-1)
@config_dir_option
@plugins_option
def train(rounds: int, steps: int, kernels: bool, overrides: tuple[str, ...]) -> None:
    """Time a training step, and its matrix products alone.

    OVERRIDES are those of `memmlp train`. The step runs on one thread of the CPU; times are processor times.
    Each round times some steps, then the same matrix products by themselves. A VQ-VAE has random weights,
    which does not affect the times; other prerequisite runs are trained if they are missing.
    """
    cost = measure_training_step(overrides, rounds, steps, kernels)
    step, products, ratio = map(np.median, (cost.step_ms, cost.product_ms, cost.ratios))
    print(f"milliseconds on one thread, median of {rounds} rounds of {steps} steps")
    print(f"{step:8.2f} training step")
    print(f"{products:8.2f} its matrix products alone, {cost.flops / 1e9:.3g} GFLOP")
    print(f"{ratio:8.2f} times the products, from {cost.ratios.min():.2f} to {cost.ratios.max():.2f}")
    for name, milliseconds, calls in cost.kernels[:20]:
        print(f"{milliseconds:8.2f} {name}, {calls:g} calls")


def measure_training_step(
    overrides: tuple[str, ...], rounds: int, steps: int, with_kernels: bool
) -> StepCost:
    """Measure the training step that overrides configure; see `measure_step_cost`."""
    experiment = build_experiment(compose_config(overrides))
    training, architecture = experiment.training, experiment.architecture
    if experiment.device.type != "cpu":
        raise InputError(f"device={experiment.config['device']}: must be cpu, whose time is measured")
    if not isinstance(training, NetworkTraining):
        raise InputError("refiner: must be null, since the steps of a network's training are timed")
    training.optim.check_installed()
    data = experiment.motion.prepare()
    with tempfile.TemporaryDirectory() as folder:
        weights = None
        if architecture.uses_codes:
            torch.manual_seed(0)
            weights = Path(folder) / "vqvae.safetensors"
            codes = checkpoint.collect_module_tensors("model", architecture.vqvae())
            checkpoint.write(weights, codes, {})
        elif run := make_prerequisites(experiment, data):
            weights = run.weights()
        task = training.make_task(architecture, data, weights, experiment.device)
    return measure_step_cost(task, training.optim, rounds, steps, with_kernels)


if __name__ == "__main__":
    train()
