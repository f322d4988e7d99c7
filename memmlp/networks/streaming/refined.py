"""The streaming graph of a network with a refiner behind it."""

from __future__ import annotations

from torch import Tensor

from memmlp.networks.memory import State
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.refiner import HIDDEN, Refined
from memmlp.networks.streaming.blocks import FrameGRU
from memmlp.networks.streaming.graph import StreamingGraph


class RefinedGraph(StreamingGraph):
    """The network's own streaming graph, followed by a step of the refiner's recurrent layers.

    Args:
        model: the network with its refiner.
        graph: the network's streaming graph.
    """

    model: Refined

    def __init__(self, model: Refined, graph: StreamingGraph):
        super().__init__(model)
        self.graph = graph
        self.float32_modules = (
            *(f"graph.{name}" for name in graph.float32_modules),
            "model.layers",
            "model.head",
        )

    def build(self, model: MotionModel) -> None:
        """Keep a copy of the refiner; the copy of the network is in its own graph."""
        assert isinstance(model, Refined)
        self.model, self.hidden = model, model.initial_state(1)[HIDDEN]
        model.add_module("layers", FrameGRU(model.layers))  # of another class than the network's

    def windows(self) -> State:
        """Return zeros: the state that the network's graph carries, and the hidden one (1, depth, width)."""
        return {**self.graph.windows(), HIDDEN: self.hidden}

    def step(self, sparse: Tensor, state: State, fresh: Tensor) -> tuple[Tensor, State]:
        """Map world inputs (1, 54) and the state to world motion (1, 198) and the new state."""
        motion, kept = self.graph.step(sparse, state, fresh)
        refined, hidden = self.model.refined(motion[None], sparse[None], state[HIDDEN])
        return refined[0], {**kept, HIDDEN: hidden}
