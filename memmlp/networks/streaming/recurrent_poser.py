"""RecurrentPoser's streaming graph."""

from __future__ import annotations

from torch import Tensor

from memmlp.networks.memory import State
from memmlp.networks.recurrent_poser import RecurrentPoser
from memmlp.networks.streaming.baselines import FrameStream
from memmlp.networks.streaming.ring import Ring


class RecurrentPoserStream(FrameStream):
    """The network as it is, its cells as plain layers for one frame."""

    ends = ("model.stem", "model.head")
    model: RecurrentPoser

    def step(self, sparse: Tensor, state: State, ring: Ring) -> tuple[Tensor, State]:
        """Map world inputs (1, 54) and the state to world motion (1, 198) and what is carried on."""
        return self.model.step(sparse, state)
