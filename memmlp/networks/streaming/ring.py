"""The interface of streaming graphs, and the ring in which they carry windows of frames."""

from __future__ import annotations

import copy
from typing import NamedTuple

import torch
from torch import Tensor, nn

from memmlp.networks.memory import State
from memmlp.networks.window_model import WindowModel


class Ring(NamedTuple):
    """Where frames stand in windows of T frames: they stay in place, and the newest overwrites the oldest.

    This spares moving the whole window by one frame at every step.

    Attributes:
        slot: index (1,) of the newest frame.
        entered: indices that a step writes to: the newest frame's, and at a fresh start all of them.
    """

    slot: Tensor
    entered: Tensor

    @classmethod
    def at(cls, count: Tensor, frames: int) -> Ring:
        """Return the ring of T = `frames` slots at a step, given the count (1,) before it (see `counted`)."""
        slot = count.remainder(frames).long()
        slots = torch.arange(frames, device=count.device)
        return cls(slot, torch.nonzero((slots == slot) | (count == 0))[:, 0])

    def put(self, window: Tensor, entering: Tensor, before: Tensor) -> Tensor:
        """Put a frame (1, size) into a window (T, size); at a fresh start `before` goes into all others."""
        window = _written(window, self.entered, before)
        return window if before is entering else _written(window, self.slot, entering)

    def newest(self, window: Tensor) -> Tensor:
        """Return the newest frame (1, size) of a window (T, size)."""
        return window.index_select(0, self.slot)


def counted(count: Tensor, frames: int) -> Tensor:
    """Return the count after a step: 1 to `frames` and then 1 again, so that only a fresh start has 0."""
    return count.remainder(frames) + 1


def _written(window: Tensor, index: Tensor, frame: Tensor) -> Tensor:
    return window.index_put((index,), frame.expand(index.shape[0], -1))


class StreamingGraph(nn.Module):
    """A network as a graph for one live stream, without gradients; the interface of all of them.

    Args:
        model: the trained network; the graph is made from a copy.

    Attributes:
        ends: names of the modules at the network's two ends: from the inputs to the hidden state, and from it
            to the motion. They stay in float32 when the graph is quantised.
    """

    ends: tuple[str, ...]

    def __init__(self, model: WindowModel):
        super().__init__()
        model = copy.deepcopy(model).eval().requires_grad_(False)
        self.frames, self.normalizer, self.branches = model.frames, model.normalizer, model.branches
        self.build(model)
        self.requires_grad_(False)

    @classmethod
    def fits(cls, model: WindowModel) -> bool:
        """Return whether a network of the graph's class has only parts that it knows."""
        return True

    def build(self, model: WindowModel) -> None:
        """Make the graph's parts from a copy of the network."""
        raise NotImplementedError

    def windows(self) -> State:
        """Return what is carried beside the count of steps, at a fresh start: zeros."""
        raise NotImplementedError

    def initial_state(self, batch: int = 1) -> State:
        """Return the state of a fresh start, all zeros.

        At the first call the first frame stands for all frames before it.

        Args:
            batch: must be 1. Without a batch axis, windows (T, size) are exported to fewer operations.
        """
        assert batch == 1
        state = {"count": torch.zeros(1), **self.windows()}
        return {name: tensor.to(self.normalizer.mean) for name, tensor in state.items() if tensor.numel()}

    def advance(self, sparse: Tensor, state: State, newest: int = 1) -> tuple[Tensor, State]:
        """Take in one frame.

        Args:
            sparse: world inputs (1, 1, 54).
            state: what the last call returned, or `initial_state`.
            newest: must be 1, since no other frame is computed.

        Returns:
            Motion (1, 1, 198) in the world, and the new state.
        """
        # Parts of the state that are empty (a queue of no frames) are no inputs of the exported graph, so
        # they are taken out of the new state and put back from `windows` here.
        ring = Ring.at(state["count"], self.frames)
        motion, kept = self.step(sparse[0], self.windows() | state, ring)
        kept["count"] = counted(state["count"], self.frames)
        return motion[None], {name: tensor for name, tensor in kept.items() if tensor.numel()}

    def step(self, sparse: Tensor, state: State, ring: Ring) -> tuple[Tensor, State]:
        """Map world inputs (1, 54) and the state to world motion (1, 198) and what is carried on."""
        raise NotImplementedError
