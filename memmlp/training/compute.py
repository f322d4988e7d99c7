"""The compute of a training: FLOPs of the matrix products in its steps."""

import copy
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple, Protocol

import torch
from torch import nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from memmlp.training.optim import Optim


class MeasurableTask(Protocol):
    """A training task (`memmlp.training.loop.TrainingTask`)."""

    module: nn.Module

    def parameter_groups(self) -> list[dict]:
        """Return the optimiser's parameter groups."""

    def step(self, step: int) -> Any:
        """Compute the loss of a training step."""

    def average_over_draws(self, measure: Callable[[], float]) -> float:
        """Return the expected value of `measure`."""


class StepCompute(NamedTuple):
    """The FLOPs of a training step: of `network` and loss, forward and backward, with a rollout's calls, and
    of the `optimiser` (0 for AdamW). A FLOP is one multiplication or addition of a matrix product."""

    network: float
    optimiser: float

    @property
    def tflop(self) -> float:
        """The FLOPs of the whole step, in 10^12."""
        return (self.network + self.optimiser) / 1e12


def measure_step(task: MeasurableTask, optim: Optim) -> StepCompute:
    """Count the FLOPs of a training step by taking a step, then restore the module. The count does not depend
    on the device: kernels that hide their matrix products are switched off."""
    before = copy.deepcopy(task.module.state_dict())
    task.module.train()

    def take_step() -> None:
        torch.manual_seed(0)
        task.step(0).loss.backward()

    def step_copy() -> None:
        groups = copy.deepcopy(task.parameter_groups())
        for parameter in (one for group in groups for one in group["params"]):
            parameter.grad = torch.zeros_like(parameter)
        optim.build(groups).step()

    with _use_plain_kernels():
        compute = StepCompute(task.average_over_draws(lambda: _count(take_step)), _count(step_copy))
    task.module.load_state_dict(before)
    task.module.zero_grad(set_to_none=True)
    return compute


def _count(call: Callable[[], None]) -> int:
    with FlopCounterMode(display=False) as counter:
        call()
    return counter.get_total_flops()


@contextmanager
def _use_plain_kernels() -> Iterator[None]:
    """Compute attention and recurrent layers by plain matrix products, and skip compiled code."""
    with ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore")  # oneDNN warns about Intel GPUs
        stack.enter_context(sdpa_kernel(SDPBackend.MATH))
        stack.enter_context(torch.backends.mkldnn.flags(enabled=False))
        stack.enter_context(torch.backends.cudnn.flags(enabled=False))
        stack.enter_context(torch.compiler.set_stance("force_eager"))
        yield
