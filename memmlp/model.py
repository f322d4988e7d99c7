"""Mem-MLP: stem, backbone of MLP and memory blocks, predictor, and the one call that moves it in time."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from memmlp.body import SPARSE_DIM
from memmlp.features import Frame
from memmlp.memory import Memory, State
from memmlp.predictor import Predictor


class MemMLP(nn.Module):
    """The network of Sec. 3.2.

    Args:
        frame: world <-> network space.
        memory, predictor: what stands in the two slots.
        frames: T, the window's length. hidden: d. depth: L, blocks of the backbone.
    """

    def __init__(
        self, frame: Frame, memory: Memory, predictor: Predictor, *, frames: int, hidden: int, depth: int
    ):
        super().__init__()
        self.frames, self.hidden = frames, hidden
        self.frame = frame
        self.memory = memory
        self.stem = nn.Linear(SPARSE_DIM, hidden)
        self.blocks = nn.ModuleList(memory.block(layer) for layer in range(1, depth + 1))
        self.predictor = predictor

    @property
    def stride(self) -> int:
        """Frames by which a training step moves: the memory's shift, 1 without one."""
        return max(self.memory.shift, 1)

    def initial_state(self, batch: int = 1) -> State:
        """A fresh start: zeros. At the first call the first frame stands for all before it."""
        state = {
            "sparse": torch.zeros(batch, self.memory.length, SPARSE_DIM),
            "started": torch.zeros(batch, 1),
        }
        state |= self.memory.initial_state(batch)
        return {name: tensor.to(self.stem.weight) for name, tensor in state.items()}

    def running_state(self, sparse: Tensor) -> State:
        """A state after world inputs (B, length, 54) that carries no history of motion yet."""
        fresh = self.initial_state(len(sparse))
        return fresh | {"sparse": sparse, "started": torch.ones_like(fresh["started"])}

    def true_state(self, frames: Tensor) -> State:
        """The state after world frames [X | Theta] (B, length, 252), with the truth as history."""
        encoded = self.frame.encode(frames)
        true = self.memory.true_state(encoded[..., :SPARSE_DIM], encoded[..., SPARSE_DIM:])
        return self.running_state(frames[..., :SPARSE_DIM]) | true

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        """Take the newest frames in.

        Args:
            sparse: world inputs (B, n, 54) of the n newest frames: 1 for a live stream, T for windows.
            state: what the last call returned, or `initial_state`.
            newest: how many of the newest frames are wanted, all T by default; the others cost no work.

        Returns:
            Motion (B, newest, 198) in the world of the window that ends with the newest frame, and the state.
        """
        new = sparse.shape[1]
        before = torch.where(state["started"][..., None] > 0, state["sparse"], sparse[:, :1])
        inputs = torch.cat([before, sparse], 1)
        place = self.frame.place(inputs)
        encoded = self.frame.encode_sparse(inputs, place)
        past = self.memory.recall(encoded, state, new)
        h = self.stem(encoded[:, -self.frames :])
        for block in self.blocks:
            h = block(h, past)
        wanted = self.frames if newest is None else newest
        made = max(wanted, self.memory.needed(new))
        motion = self.predictor(h, past, inputs[:, -self.frames :], self.frame, made)
        kept = {"sparse": inputs[:, -self.memory.length :], "started": state["started"].clamp_min(1)}
        kept |= self.memory.remember(motion, past, state, new)
        return self.frame.decode_motion(motion[:, -wanted:], place[:, -wanted:]), kept

    def count_parameters(self) -> int:
        """Trainable parameters, the number that the tables call #Params.

        A frozen VQ-VAE is not counted; one that is trained with the network is, its decoder included.
        """
        return sum(p.numel() for p in self.parameters() if p.requires_grad)
