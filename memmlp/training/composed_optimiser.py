"""Several optimisers, each with parameters of its own, as one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch.optim import Optimizer

from memmlp.training.bfloat16_products import wide_where_needed


class ComposedOptimiser(Optimizer):
    """Several optimisers as one, with the parameter groups and the state of all of them.

    Args:
        parts: the optimisers, which have no parameter in common.
    """

    def __init__(self, parts: Sequence[Optimizer]):
        self.parts = tuple(parts)
        super().__init__([group for part in parts for group in part.param_groups], {})
        self._share()

    def _share(self) -> None:
        """Make the parts use the whole's groups and state themselves, not copies."""
        start = 0
        for part in self.parts:
            end = start + len(part.param_groups)
            part.param_groups, part.state = self.param_groups[start:end], self.state
            start = end

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> None:  # type: ignore[override]
        """Take a step of each part; a closure is not supported."""
        with wide_where_needed():
            for part in self.parts:
                part.step()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load the groups and the state of all parts."""
        super().load_state_dict(state_dict)
        self._share()
