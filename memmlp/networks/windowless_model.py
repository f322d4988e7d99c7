"""The interface of networks without a window, which take in frames one after the other, each once."""

from __future__ import annotations

from torch import Tensor

from memmlp.networks.memory import State
from memmlp.networks.motion_model import MotionModel


class WindowlessModel(MotionModel):
    """A network that carries all it knows of the past in its state; every live step takes the same work.

    `frames` is how many frames a training call takes in, from a fresh start. In both evaluation modes the
    network is a stream over the whole clip.
    """

    @property
    def windowless(self) -> bool:
        """Whether the network has no window; true here."""
        return True

    @property
    def past_frames(self) -> int:
        """How many past frames of inputs are kept in a buffer; 0 here."""
        return 0

    @property
    def stride(self) -> int:
        """By how many frames a training step moves on: by all that it takes in."""
        return self.frames

    def initial_state(self, batch: int = 1) -> State:
        """Return the state of a fresh start, all zeros; by default nothing is carried."""
        return {}

    def running_state(self, sparse: Tensor) -> State:
        """Return the state of a fresh start, since no earlier frames (B, 0, 54) are kept."""
        return self.initial_state(len(sparse))
