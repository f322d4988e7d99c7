"""The interface of every network: one call takes in new frames and returns motion and a state."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.memory import State


class TrainingOutputs(NamedTuple):
    """What a training call returns.

    Attributes:
        motion: (B, n, 198) in the world, to be compared with the true motion of the window's last n frames. A
            network whose members each learn by themselves returns the motion of all members, one after the
            other: (members B, n, 198).
        state: the new state.
        losses: the network's own further losses, weighted, which are added to the motion's losses.
    """

    motion: Tensor
    state: State
    losses: dict[str, Tensor]


class MotionModel(nn.Module):
    """A network that takes in frames by calls of `advance`; the interface of all networks.

    Evaluation, export, timing and training know no more of a network than this. In this base class a
    network sees a window, the last T frames, and its state is only the buffer of past inputs (WindowlessModel
    has none).

    Args:
        normalizer: converts between the world and network space.
        frames: T, the window's length.

    Attributes:
        branches: the parts of the motion that are learned, out of "rotation" and "position"; positions that
            are not learned follow from the rotations.
    """

    branches: frozenset[str] = frozenset({"rotation"})

    def __init__(self, normalizer: Normalizer, frames: int):
        super().__init__()
        self.normalizer = normalizer
        self.frames = frames

    @property
    def shift(self) -> int:
        """How many frames before the newest one the recalled past ends; 0 for a network that recalls none."""
        return 0

    @property
    def settled(self) -> bool:
        """Whether a past frame's recalled values never change again, so that a live stream may keep them."""
        return True

    @property
    def windowless(self) -> bool:
        """Whether the network has no window and is a stream in both evaluation modes; see WindowlessModel."""
        return False

    @property
    def is_stream(self) -> bool:
        """Whether each frame is predicted without later ones; if not, only window mode can evaluate it."""
        return True

    @property
    def takes_whole_clip(self) -> bool:
        """Whether window mode passes a whole clip to `whole`, which makes all its windows together.

        Such windows may overlap.
        """
        return False

    @property
    def past_frames(self) -> int:
        """How many past frames of inputs the buffer holds; the last one directly precedes the new ones."""
        return self.frames - 1

    @property
    def stride(self) -> int:
        """By how many frames a training step moves on: the shift, or 1 for a network without a past."""
        return max(self.shift, 1)

    def initial_state(self, batch: int = 1) -> State:
        """Return the state of a fresh start, all zeros.

        At the first call the first frame's inputs stand for those of all frames before it.
        """
        state = {"sparse": torch.zeros(batch, self.past_frames, SPARSE_DIM), "started": torch.zeros(batch, 1)}
        return {name: tensor.to(self.normalizer.mean) for name, tensor in state.items()}

    def running_state(self, sparse: Tensor) -> State:
        """Return the state after world inputs (B, past, 54), without any history of motion yet."""
        fresh = self.initial_state(len(sparse))
        return fresh | {"sparse": sparse, "started": torch.ones_like(fresh["started"])}

    def true_state(self, frames: Tensor) -> State:
        """Return the state after true world frames [X | Theta] (B, past, 252), the truth as its history."""
        return self.running_state(frames[..., :SPARSE_DIM])

    def taken_in(self, sparse: Tensor, state: State) -> tuple[Tensor, State]:
        """Return past and new inputs together (B, past + n, 54), and the buffers after them.

        Args:
            sparse: new world inputs (B, n, 54).
            state: what the last call returned, or `initial_state`.
        """
        before = torch.where(state["started"][..., None] > 0, state["sparse"], sparse[:, :1])
        inputs = torch.cat([before, sparse], 1)
        return inputs, {"sparse": inputs[:, -self.past_frames :], "started": state["started"].clamp_min(1)}

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        """Take in the newest frames.

        Args:
            sparse: world inputs (B, n, 54) of the n newest frames: n is 1 for a live stream, T for windows,
                and fewer for what is left at a clip's end.
            state: what the last call returned, or `initial_state`.
            newest: how many of the newest frames are wanted; by default all that the network predicts.

        Returns:
            Motion (B, newest, 198) in the world, of the frames that end with the newest one, and the new
            state.
        """
        raise NotImplementedError

    def whole(self, sparse: Tensor) -> Tensor:
        """Map a clip's world inputs (N, 54), N >= T, to its world motion (N, 198); see `takes_whole_clip`."""
        raise NotImplementedError

    def training_call(self, sparse: Tensor, state: State, true_frames: Tensor) -> TrainingOutputs:
        """Make a training call; by default this is `advance`.

        Args:
            sparse: see `advance`.
            state: see `advance`.
            true_frames: world frames [X | Theta] (B, T, 252) of the window.
        """
        return TrainingOutputs(*self.advance(sparse, state), {})

    def count_parameters(self) -> int:
        """Count the trainable parameters; tables show this number in millions.

        A frozen VQ-VAE is not counted; one that is trained with the network is, its decoder included.
        """
        return sum(p.numel() for p in self.parameters() if p.requires_grad)
