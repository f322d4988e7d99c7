"""The weights that a training keeps: those with the lowest validation error, or the last ones."""

from __future__ import annotations

import math
from typing import Any

from torch import Tensor, nn

from memmlp.common.errors import InputError
from memmlp.training.optim import Average


class BestWeights:
    """The weights with the lowest MPJPE of a branch on validation. A checkpoint holds them, too.

    Args:
        module: the module that is trained.
        branch: "rotation" or "position"; None keeps the last weights.

    Attributes:
        step: the step of the kept weights; 0 before the first validation, and without a branch.
    """

    def __init__(self, module: nn.Module, branch: str | None):
        self.module, self.metric = module, f"{branch} MPJPE" if branch else None
        self.step, self.error = 0, math.inf
        self.weights: dict[str, Tensor] = {}

    def update(self, step: int, values: dict[str, float], average: Average) -> None:
        """Keep a copy of the final weights (see Average) if their error is the lowest so far.

        Raises:
            InputError: if the branch's error is not among the validation's values.
        """
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
        self.weights = {
            name.removeprefix("best."): one for name, one in tensors.items() if name.startswith("best.")
        }
        self.step, self.error = values.get("best", (0, math.inf))
