"""What every network is: it sees a window of frames, and one call moves it in time. And Mem-MLP."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.memory import State


class WindowModel(nn.Module):
    """A network that sees the last T frames and is moved in time by `advance`; the interface of all of them.

    Evaluation, export, timing and training know no more of a network than this. As it stands, the state is
    the buffer of inputs.

    Args:
        normalizer: world <-> network space.
        frames: T, the window's length.

    Attributes:
        branches: what of the motion is learned, "rotation" and "position"; the rest follows from it.
    """

    branches: frozenset[str] = frozenset({"rotation"})

    def __init__(self, normalizer: Normalizer, frames: int):
        super().__init__()
        self.normalizer = normalizer
        self.frames = frames

    @property
    def shift(self) -> int:
        """Frames by which the network's own past, which it sees, ends before the newest; 0 without one."""
        return 0

    @property
    def settled(self) -> bool:
        """Whether what it recalls of a frame never changes, so that a live stream can carry it."""
        return True

    @property
    def length(self) -> int:
        """Frames of inputs in the buffer, the last one just before the new ones."""
        return self.frames - 1

    @property
    def stride(self) -> int:
        """Frames by which a training step moves: the shift, 1 without a past."""
        return max(self.shift, 1)

    def initial_state(self, batch: int = 1) -> State:
        """A fresh start: zeros. At the first call the first frame stands for all before it."""
        state = {"sparse": torch.zeros(batch, self.length, SPARSE_DIM), "started": torch.zeros(batch, 1)}
        return {name: tensor.to(self.normalizer.mean) for name, tensor in state.items()}

    def running_state(self, sparse: Tensor) -> State:
        """A state after world inputs (B, length, 54) that carries no history of motion yet."""
        fresh = self.initial_state(len(sparse))
        return fresh | {"sparse": sparse, "started": torch.ones_like(fresh["started"])}

    def true_state(self, frames: Tensor) -> State:
        """The state after world frames [X | Theta] (B, length, 252), with the truth as history."""
        return self.running_state(frames[..., :SPARSE_DIM])

    def taken_in(self, sparse: Tensor, state: State) -> tuple[Tensor, State]:
        """The buffer's inputs and the new ones (B, length + n, 54), and the buffer after them."""
        before = torch.where(state["started"][..., None] > 0, state["sparse"], sparse[:, :1])
        inputs = torch.cat([before, sparse], 1)
        return inputs, {"sparse": inputs[:, -self.length :], "started": state["started"].clamp_min(1)}

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        """Take the newest frames in.

        Args:
            sparse: world inputs (B, n, 54) of the n newest frames: 1 for a live stream, T for windows.
            state: what the last call returned, or `initial_state`.
            newest: how many of the newest frames are wanted; by default all that the network makes.

        Returns:
            Motion (B, newest, 198) in the world of the frames that end with the newest one, and the state.
        """
        raise NotImplementedError

    def learn(self, sparse: Tensor, state: State, truth: Tensor) -> tuple[Tensor, State]:
        """A training call: `advance`, for networks that learn by what they do live.

        Args:
            sparse, state: see `advance`. truth: world frames [X | Theta] (B, T, 252) of the window.
        """
        return self.advance(sparse, state)

    def auxiliary_losses(self, truth: Tensor) -> dict[str, Tensor]:
        """Losses of its own at true world frames (B, T, 252), added to the loss of the motion."""
        return {}

    def count_parameters(self) -> int:
        """Trainable parameters, the number that the tables call #Params.

        A frozen VQ-VAE is not counted; one that is trained with the network is, its decoder included.
        """
        return sum(p.numel() for p in self.parameters() if p.requires_grad)
