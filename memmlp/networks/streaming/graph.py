"""The interface of streaming graphs, and how a frame enters the windows that they carry.

A step has static shapes and no operation that depends on the data's values (no condition, no computed index),
so that accelerators can run all of it.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from memmlp.networks.memory import State
from memmlp.networks.motion_model import MotionModel


def filled(earlier: Tensor, first: Tensor, fresh: Tensor) -> Tensor:
    """Return a window's earlier frames, which at a fresh start are all copies of the first frame.

    The carried frames are zeros then, so a sum is enough; a condition is not available in every runtime.

    Args:
        earlier: the carried frames (n, size).
        first: the copy that stands for earlier frames (1, size).
        fresh: 1 at a fresh start and 0 after it (1,).
    """
    return earlier + fresh * first


def slid(window: Tensor, entering: Tensor, before: Tensor, fresh: Tensor) -> Tensor:
    """Return a window (T, size) without its oldest frame and with a new one (1, size) at its end.

    At a fresh start `before` (1, size) stands for the frames before it; see `filled`.
    """
    return torch.cat([filled(window[1:], before, fresh), entering])


def counted(count: Tensor, frames: int) -> Tensor:
    """Return the count (1,) of frames taken in, after one more step; it grows no further than `frames`."""
    return count.clamp_max(frames - 1) + 1


class StreamingGraph(nn.Module):
    """A network as a graph for one live stream, without gradients; the interface of all of them.

    Args:
        model: the trained network; the graph is made from a copy.

    Attributes:
        float32_modules: names of the modules that stay in float32 when the graph is quantised: those at the
            network's two ends, from the inputs to the hidden state and from there to the motion, and others
            whose rounding would be visible.
    """

    float32_modules: tuple[str, ...]

    def __init__(self, model: MotionModel):
        super().__init__()
        model = copy.deepcopy(model).eval().requires_grad_(False)
        self.frames, self.normalizer, self.branches = model.frames, model.normalizer, model.branches
        self.build(model)
        self.requires_grad_(False)

    @classmethod
    def fits(cls, model: MotionModel) -> bool:
        """Return whether this graph can stream this very model: its memory, its sizes."""
        return True

    def build(self, model: MotionModel) -> None:
        """Make the graph's parts from a copy of the network."""
        raise NotImplementedError

    def windows(self) -> State:
        """Return the state of a fresh start, without the count of steps: zeros."""
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
        fresh = 1 - state["count"].clamp_max(1)
        motion, kept = self.step(sparse[0], self.windows() | state, fresh)
        kept["count"] = counted(state["count"], self.frames)
        return motion[None], {name: tensor for name, tensor in kept.items() if tensor.numel()}

    def step(self, sparse: Tensor, state: State, fresh: Tensor) -> tuple[Tensor, State]:
        """Take in one frame.

        Args:
            sparse: world inputs (1, 54).
            state: the state, all zeros at a fresh start.
            fresh: 1 at a fresh start and 0 after it (1,).

        Returns:
            World motion (1, 198), and the new state.
        """
        raise NotImplementedError
