"""What every stream is, and the ring in which it carries windows of frames."""

from __future__ import annotations

import copy
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from memmlp.networks.memory import State
from memmlp.networks.window_model import WindowModel


class Ring(NamedTuple):
    """Where the newest of T frames stands in windows whose frames stay in place, the oldest one overwritten.

    slot: the newest frame's index (1,). entered: the indices that a step writes to: that slot, and at a fresh
    start all of them.
    """

    slot: Tensor
    entered: Tensor

    @classmethod
    def at(cls, count: Tensor, frames: int) -> Ring:
        """The ring of `frames` slots after a count (1,) of steps; see `counted`."""
        slot = count.remainder(frames).long()
        slots = torch.arange(frames, device=count.device)
        return cls(slot, torch.nonzero((slots == slot) | (count == 0))[:, 0])

    def put(self, window: Tensor, entering: Tensor, before: Tensor) -> Tensor:
        """The window (T, size) with a frame (1, size); at a fresh start `before` it in all others."""
        window = _written(window, self.entered, before)
        return window if before is entering else _written(window, self.slot, entering)

    def newest(self, window: Tensor) -> Tensor:
        """The newest frame (1, size) of a window (T, size)."""
        return window.index_select(0, self.slot)


def counted(count: Tensor, frames: int) -> Tensor:
    """The count of steps after this one: 0 is a fresh start only, and after `frames` comes 1 again."""
    return count.remainder(frames) + 1


def _written(window: Tensor, index: Tensor, normalizer: Tensor) -> Tensor:
    return window.index_put((index,), normalizer.expand(index.shape[0], -1))


class StreamingGraph(nn.Module):
    """A network as a live stream, for one stream and without gradients.

    Args:
        model: the trained network; what is shared with it is a copy.

    Attributes:
        ends: names of the modules that make the hidden state of the inputs, and the motion of it.
    """

    ends: ClassVar[tuple[str, ...]]

    def __init__(self, model: WindowModel):
        super().__init__()
        model = copy.deepcopy(model).eval().requires_grad_(False)
        self.frames, self.normalizer, self.branches = model.frames, model.normalizer, model.branches
        self.build(model)
        self.requires_grad_(False)

    def build(self, model: WindowModel) -> None:
        """Make the stream's parts of a copy of the network."""
        raise NotImplementedError

    def windows(self) -> State:
        """What is carried beside the count of steps, at a fresh start: zeros."""
        raise NotImplementedError

    def initial_state(self, batch: int = 1) -> State:
        """A fresh start: zeros. At the first call the first frame stands for all before it.

        batch: 1. Windows are (T, size), which exports to fewer operations.
        """
        assert batch == 1
        state = {"count": torch.zeros(1), **self.windows()}
        return {name: tensor.to(self.normalizer.mean) for name, tensor in state.items() if tensor.numel()}

    def advance(self, sparse: Tensor, state: State, newest: int = 1) -> tuple[Tensor, State]:
        """Take one frame in.

        Args:
            sparse: world inputs (1, 1, 54). state: what the last call returned, or `initial_state`.
            newest: 1; no other frame is made.

        Returns:
            Motion (1, 1, 198) in the world, and the state.
        """
        ring = Ring.at(state["count"], self.frames)
        motion, kept = self.step(sparse[0], self.windows() | state, ring)
        kept["count"] = counted(state["count"], self.frames)
        return motion[None], {name: tensor for name, tensor in kept.items() if tensor.numel()}

    def step(self, sparse: Tensor, state: State, ring: Ring) -> tuple[Tensor, State]:
        """World inputs (1, 54) and the state -> motion (1, 198) in the world, and what is carried on."""
        raise NotImplementedError
