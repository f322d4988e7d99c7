"""RecurrentPoser's streaming graph."""

from __future__ import annotations

from torch import Tensor

from memmlp.networks.memory import State
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.recurrent_poser import RecurrentPoser
from memmlp.networks.streaming.baselines import FrameGraph
from memmlp.networks.streaming.one_frame_normalizer import OneFrameNormalizer


class RecurrentPoserGraph(FrameGraph):
    """RecurrentPoser's streaming graph: the network itself, with cells written as plain layers for one frame.

    When the graph is quantised, only the cells become int8: a state averages the rounding errors of many
    frames, whereas the MLPs would pass them on to the motion, where they show as jitter.
    """

    model: RecurrentPoser

    def build(self, model: MotionModel) -> None:
        """Make the graph's parts from a copy of the network."""
        assert isinstance(model, RecurrentPoser)
        self.model = model
        self.model.normalizer = OneFrameNormalizer(model.normalizer)
        outer = ["model.normalizer"]
        for name, member in model.named_members():
            inner = ["stem", *(f"blocks.{block}.mlp" for block in member.blocks), "head"]
            outer += [f"model.members.{name}.{part}" for part in inner]
        self.float32_modules = tuple(outer)

    def step(self, sparse: Tensor, state: State, fresh: Tensor) -> tuple[Tensor, State]:
        """Map world inputs (1, 54) and the state to world motion (1, 198) and the new state."""
        return self.model.step(sparse, state)
