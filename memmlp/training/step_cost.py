"""The cost of a training step: its processor time, and the time of its matrix products alone."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from memmlp.motion.geometry import limit_to_one_thread
from memmlp.training.loop import TrainingTask, seed_step, train_step
from memmlp.training.optim import Optim

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
