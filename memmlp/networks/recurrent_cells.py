"""Recurrent cells, from which a network without a window chooses one by its name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

SHORTEST, LONGEST = 0.9, 0.999
"""The least share of its state that a fresh LRU's first and last unit keep from frame to frame."""


class RecurrentCell(nn.Module):
    """A recurrent layer of d inputs and d outputs; the interface of all of them.

    `forward` takes in a whole sequence, as in training, and `step` one frame, as live; they compute the same.

    Args:
        width: d.

    Attributes:
        carried: how many numbers each of the d units carries from frame to frame.
    """

    carried: ClassVar[int] = 1

    def __init__(self, width: int):
        super().__init__()
        self.size = self.carried * width

    def forward(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Run over inputs (B, n, d) from a state (B, size).

        Returns:
            Outputs (B, n, d), and the state after the last input.
        """
        raise NotImplementedError

    def step(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Take in one input (B, d) at a state (B, size).

        Returns:
            The output (B, d), and the state after it.
        """
        raise NotImplementedError


def products(weights: Sequence[Tensor], x: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
    """Return the contributions of an input (B, n) and of the hidden state (B, d) to a layer's gates.

    Args:
        weights: the layer's weights and biases, in the order of `nn.RNNBase.all_weights`.
        x: the input.
        hidden: the hidden state.
    """
    of_input, of_hidden, input_bias, hidden_bias = weights
    return F.linear(x, of_input, input_bias), F.linear(hidden, of_hidden, hidden_bias)


def gru_step(weights: Sequence[Tensor], x: Tensor, state: Tensor) -> Tensor:
    """Return a GRU layer's state (B, d) after an input (B, n) at a state (B, d), in plain layers."""
    entering, again = (part.chunk(3, -1) for part in products(weights, x, state))
    reset, keep = (torch.sigmoid(entering[gate] + again[gate]) for gate in range(2))
    new = torch.tanh(entering[2] + reset * again[2])
    return new + keep * (state - new)


class GRUCell(RecurrentCell):
    """A gated recurrent unit (Cho et al. 2014)."""

    def __init__(self, width: int):
        super().__init__(width)
        self.layer = nn.GRU(width, width, batch_first=True)

    def forward(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Run over inputs (B, n, d) from a state (B, d); see RecurrentCell."""
        made, after = self.layer(x, state[None].contiguous())
        return made, after[0]

    def step(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Take in one input (B, d) at a state (B, d); see RecurrentCell."""
        state = gru_step(self.layer.all_weights[0], x, state)
        return state, state


class LSTMCell(RecurrentCell):
    """A long short-term memory (Hochreiter & Schmidhuber 1997); its state is hidden state, then cell."""

    carried = 2

    def __init__(self, width: int):
        super().__init__(width)
        self.layer = nn.LSTM(width, width, batch_first=True)

    def forward(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Run over inputs (B, n, d) from a state (B, 2 d); see RecurrentCell."""
        hidden, cell = (part[None].contiguous() for part in state.chunk(2, -1))
        made, after = self.layer(x, (hidden, cell))
        return made, torch.cat(after, -1)[0]

    def step(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Take in one input (B, d) at a state (B, 2 d); see RecurrentCell."""
        hidden, cell = state.chunk(2, -1)
        entering, again = products(self.layer.all_weights[0], x, hidden)
        enter, keep, new, show = (entering + again).chunk(4, -1)
        cell = torch.sigmoid(keep) * cell + torch.sigmoid(enter) * torch.tanh(new)
        hidden = torch.sigmoid(show) * torch.tanh(cell)
        return hidden, torch.cat([hidden, cell], -1)


def scan(keep: Tensor, new: Tensor, state: Tensor) -> Tensor:
    """Return h_t = keep_t h_(t-1) + new_t for all frames, in log2(n) passes over all of them.

    Each pass doubles the number of past frames that a frame's h holds (Hillis & Steele 1986).

    Args:
        keep: the share of each unit's state that is kept (B, n, d).
        new: what is added to it (B, n, d).
        state: h before the first frame (B, d).

    Returns:
        (B, n, d).
    """
    keep, h = F.pad(keep, (0, 0, 1, 0)), torch.cat([state[:, None], new], 1)
    held = 1
    while held < h.shape[1]:
        h = h + keep * F.pad(h[:, :-held], (0, 0, held, 0))
        keep = keep * F.pad(keep[:, :-held], (0, 0, held, 0))
        held *= 2
    return h[:, 1:]


class LinearCell(RecurrentCell):
    """The base of cells whose units are linear in their own state, so that all frames are made at once."""

    def gates(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Map inputs (..., d) to the share of the state that is kept and to what is added, both (..., d)."""
        raise NotImplementedError

    def forward(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Run over inputs (B, n, d) from a state (B, d); see RecurrentCell."""
        h = scan(*self.gates(x), state)
        return h, h[:, -1]

    def step(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Take in one input (B, d) at a state (B, d); see RecurrentCell."""
        keep, new = self.gates(x)
        state = keep * state + new
        return state, state


class MinGRU(LinearCell):
    """A GRU whose gate and candidate see the input alone (Feng et al. 2024)."""

    def __init__(self, width: int):
        super().__init__(width)
        self.linear = nn.Linear(width, 2 * width)

    def gates(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Map inputs (..., d) to the share that is kept and to what is added; see LinearCell."""
        gate, new = self.linear(x).chunk(2, -1)
        update = torch.sigmoid(gate)
        return 1 - update, update * new


class LRU(LinearCell):
    """A real-gated linear recurrent unit (De et al. 2024), with a learned decay for each unit."""

    def __init__(self, width: int):
        super().__init__(width)
        self.linear = nn.Linear(width, 3 * width)
        rate = -torch.linspace(SHORTEST, LONGEST, width).log()
        self.decay = nn.Parameter(rate.expm1().log())  # softplus makes the rate of it

    def gates(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Map inputs (..., d) to the share that is kept and to what is added; see LinearCell."""
        forget, enter, new = self.linear(x).chunk(3, -1)
        keep = torch.exp(-F.softplus(self.decay) * torch.sigmoid(forget))
        room = (1 - keep.square()).clamp_min(1e-6).sqrt()  # keeps the state's variance that of its inputs
        return keep, room * torch.sigmoid(enter) * new


CELLS: dict[str, type[RecurrentCell]] = {"gru": GRUCell, "lstm": LSTMCell, "mingru": MinGRU, "lru": LRU}
"""The cells by the names that the config knows."""
