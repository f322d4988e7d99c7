"""Mem-MLP, the network of Sec. 3.2."""

from __future__ import annotations

from torch import Tensor, nn

from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.memory import Memory, State
from memmlp.networks.predictor import Predictor
from memmlp.networks.window_model import WindowModel


class MemMLP(WindowModel):
    """The network of Sec. 3.2: stem, backbone of MLP and memory blocks, predictor.

    Args:
        normalizer: world <-> network space.
        memory, predictor: what stands in the two slots.
        frames: T, the window's length. hidden: d. depth: L, blocks of the backbone.
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
        """Frames by which what the memory recalls ends before the newest; 0 without a memory."""
        return self.memory.shift

    @property
    def settled(self) -> bool:
        """Whether the memory's estimates of past frames stay as they were first made."""
        return self.memory.settled

    @property
    def length(self) -> int:
        """Frames of inputs that the memory wants kept."""
        return self.memory.length

    def initial_state(self, batch: int = 1) -> State:
        """A fresh start: zeros. At the first call the first frame stands for all before it."""
        kept = self.memory.initial_state(batch)
        return super().initial_state(batch) | {name: t.to(self.normalizer.mean) for name, t in kept.items()}

    def true_state(self, frames: Tensor) -> State:
        """The state after world frames [X | Theta] (B, length, 252), with the truth as history."""
        encoded = self.normalizer.encode(frames)
        true = self.memory.true_state(encoded[..., :SPARSE_DIM], encoded[..., SPARSE_DIM:])
        return super().true_state(frames) | true

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        """See WindowModel; all T frames by default, and those that are not wanted cost no work."""
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

    def auxiliary_losses(self, truth: Tensor) -> dict[str, Tensor]:
        """The losses of the memory itself (a VQ-VAE that is trained with the network has some)."""
        return self.memory.auxiliary_losses(truth, self.normalizer)
