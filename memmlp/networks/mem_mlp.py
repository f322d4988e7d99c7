"""Mem-MLP, the network of Sec. 3.2."""

from __future__ import annotations

from torch import Tensor, nn

from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.memory import Memory, State
from memmlp.networks.motion_model import MotionModel, TrainingOutputs
from memmlp.networks.predictor_slot import Predictor


class MemMLP(MotionModel):
    """The network of Sec. 3.2: a linear stem, a backbone of MLP and memory blocks, and a predictor.

    Args:
        normalizer: converts between the world and network space.
        memory: what fills the memory slot.
        predictor: what fills the predictor slot.
        frames: T, the window's length.
        hidden: d, the width of the hidden state.
        depth: L, the number of the backbone's blocks.
    """

    def __init__(
        self,
        normalizer: Normalizer,
        memory: Memory,
        predictor: Predictor,
        *,
        frames: int,
        hidden: int,
        depth: int,
    ):
        super().__init__(normalizer, frames)
        self.hidden = hidden
        self.memory = memory
        self.stem = nn.Linear(SPARSE_DIM, hidden)
        self.blocks = nn.ModuleList(memory.block(layer) for layer in range(1, depth + 1))
        self.predictor = predictor
        self.branches = predictor.branches

    @property
    def shift(self) -> int:
        """How many frames before the newest one the memory's recalled past ends; 0 without a memory."""
        return self.memory.shift

    @property
    def settled(self) -> bool:
        """Whether the memory never changes an estimate of a past frame once it is made."""
        return self.memory.settled

    @property
    def past_frames(self) -> int:
        """How many past frames of inputs the memory needs in the buffer."""
        return self.memory.past_frames

    def initial_state(self, batch: int = 1) -> State:
        """Return the state of a fresh start, all zeros.

        At the first call the first frame's inputs stand for those of all frames before it.
        """
        kept = self.memory.initial_state(batch)
        return super().initial_state(batch) | {name: t.to(self.normalizer.mean) for name, t in kept.items()}

    def true_state(self, frames: Tensor) -> State:
        """Return the state after world frames [X | Theta] (B, past, 252), with the truth as its history."""
        encoded = self.normalizer.encode(frames)
        true = self.memory.true_state(encoded[..., :SPARSE_DIM], encoded[..., SPARSE_DIM:])
        return super().true_state(frames) | true

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        """Take in the newest frames; see MotionModel.

        By default all T frames are returned. If fewer are wanted, the predictor's last blocks skip the
        others.
        """
        new = sparse.shape[1]
        inputs, kept = self.taken_in(sparse, state)
        origin = self.normalizer.origin(inputs)
        encoded = self.normalizer.encode_sparse(inputs, origin)
        past = self.memory.recall(encoded, state, new)
        h = self.stem(encoded[:, -self.frames :])
        for block in self.blocks:
            h = block(h, past)
        wanted = self.frames if newest is None else newest
        made = max(wanted, self.memory.needed(new))
        motion = self.predictor(h, past, inputs[:, -self.frames :], self.normalizer, made)
        kept |= self.memory.remember(motion, past, state, new)
        return self.normalizer.decode_motion(motion[:, -wanted:], origin[:, -wanted:]), kept

    def training_call(self, sparse: Tensor, state: State, true_frames: Tensor) -> TrainingOutputs:
        """Make a training call; a memory whose VQ-VAE trains with the network adds losses of its own."""
        motion, kept = self.advance(sparse, state)
        return TrainingOutputs(motion, kept, self.memory.auxiliary_losses(true_frames, self.normalizer))
