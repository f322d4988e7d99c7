"""Which weights a training validates and keeps: those of the last step, or an average over the steps.

These are called the weights that count. A checkpoint has both the last step's weights and the average, so
that a resumed training continues as if it had never stopped. Only parameters are averaged; buffers, such as a
codebook's statistics, are the last step's.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn


class Average:
    """The weights of a module that count: they are validated, and kept at the end.

    In this base class they are the weights of the last step, without an average.

    Args:
        module: the module that is trained.
    """

    def __init__(self, module: nn.Module):
        self.parameters = dict(module.named_parameters())

    def update(self, steps: int) -> None:
        """Update the average with the module's weights after `steps` steps."""

    def put_in_place(self) -> None:
        """Put the weights that count into the module, for good."""

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that a checkpoint must hold, their names preceded by "average."."""
        return {}

    def load(self, tensors: dict[str, Tensor]) -> None:
        """Load from a checkpoint's tensors those that `tensors` returned."""

    @contextlib.contextmanager
    def in_place(self) -> Iterator[None]:
        """Give the module the weights that count within the context, then the last step's, bit for bit."""
        before = {name: one.detach().clone() for name, one in self.parameters.items()}
        self.put_in_place()
        try:
            yield
        finally:
            self._put(before)

    @torch.no_grad()
    def _put(self, values: dict[str, Tensor]) -> None:
        for name, one in self.parameters.items():
            one.copy_(values[name])


class EMA(Average):
    """An exponential moving average of the weights.

    The decay grows to its value as (1 + steps) / (10 + steps), so that the random first weights are soon
    forgotten.

    Args:
        module: the module that is trained.
        decay: the share of the old average that is kept at each step, in (0, 1).
    """

    def __init__(self, module: nn.Module, decay: float):
        super().__init__(module)
        self.decay = decay
        self.averages = {name: one.detach().clone() for name, one in self.parameters.items()}

    def update(self, steps: int) -> None:
        decay = min(self.decay, (1 + steps) / (10 + steps))
        weights = [one.detach() for one in self.parameters.values()]
        get_ema_multi_avg_fn(decay)(list(self.averages.values()), weights, steps)

    def put_in_place(self) -> None:
        self._put(self.averages)

    def tensors(self) -> dict[str, Tensor]:
        """Return the average of each parameter."""
        return {f"average.{name}": value for name, value in self.averages.items()}

    def load(self, tensors: dict[str, Tensor]) -> None:
        for name, value in self.averages.items():
            value.copy_(tensors[f"average.{name}"])


class ScheduleFreeAverage(Average):
    """The average that a schedule-free optimiser maintains itself, and shows in its evaluation mode.

    Args:
        module: the module that is trained.
        optimiser: an optimiser of the package schedulefree, in its training mode.
    """

    COUNTERS = ("k", "weight_sum", "lr_max")
    """What its groups count besides their settings: steps, sum of the average's weights, largest rate."""

    def __init__(self, module: nn.Module, optimiser: torch.optim.Optimizer):
        super().__init__(module)
        self.optimiser = optimiser

    def put_in_place(self) -> None:
        self.optimiser.eval()  # type: ignore[attr-defined]

    @contextlib.contextmanager
    def in_place(self) -> Iterator[None]:
        """Give the module the average within the context, then back the last step's weights, bit for bit.

        The optimiser can restore the last step's weights by itself, but not bit for bit.
        """
        with super().in_place():
            yield
            self.optimiser.train()  # type: ignore[attr-defined]

    def tensors(self) -> dict[str, Tensor]:
        """Return the counters of each parameter group (groups, 3)."""
        counted = [[group[name] for name in self.COUNTERS] for group in self.optimiser.param_groups]
        return {"average.counters": torch.tensor(counted, dtype=torch.float64)}

    def load(self, tensors: dict[str, Tensor]) -> None:
        """Load the counters."""
        counted = tensors["average.counters"].tolist()
        for group, values in zip(self.optimiser.param_groups, counted, strict=True):
            steps, weight_sum, lr_max = values
            group.update(zip(self.COUNTERS, (int(steps), weight_sum, lr_max), strict=True))
