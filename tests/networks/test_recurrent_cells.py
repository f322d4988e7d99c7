"""Recurrent cells: a step is the sequence's, and each is what its authors' equations say."""

import numpy as np
import pytest
import torch

from memmlp.networks.recurrent_poser import CELLS, RecurrentCell, scan

X = torch.randn(2, 9, 4, generator=torch.Generator().manual_seed(1)).double()


def cell(name: str) -> tuple[RecurrentCell, torch.Tensor]:
    """A cell of width 4 with random weights, and a random state."""
    torch.manual_seed(2)
    made = CELLS[name](4).double()
    return made, torch.randn(2, made.size).double()


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-x))


@pytest.mark.parametrize("name", CELLS)
@torch.no_grad()
def test_steps_are_the_sequence_however_it_is_cut(name):
    made, state = cell(name)
    whole, last = made(X, state)
    first, between = made(X[:, :5], state)
    second, end = made(X[:, 5:], between)
    torch.testing.assert_close(torch.cat([first, second], 1), whole, atol=1e-12, rtol=0)
    stepped = []
    for frame in X.unbind(1):
        out, state = made.step(frame, state)
        stepped.append(out)
    torch.testing.assert_close(torch.stack(stepped, 1), whole, atol=1e-12, rtol=0)
    for found in (end, state):
        torch.testing.assert_close(found, last, atol=1e-12, rtol=0)


@pytest.mark.parametrize("name", CELLS)
@torch.no_grad()
def test_a_state_counts_and_each_frame_does(name):
    made, state = cell(name)
    base = made(X, state)[0]
    assert (made(X, state + 1)[0] - base).abs().amax(-1).min() > 1e-6
    later = X.clone()
    later[:, 4] += 1
    changed = (made(later, state)[0] - base).abs().amax((0, 2))
    assert changed[:4].max() == 0
    assert changed[4:].min() > 1e-6


@pytest.mark.parametrize("length", [1, 2, 7, 8])
def test_the_scan_is_the_recurrence(length):
    random = np.random.default_rng(0)
    keep, new, state = (
        random.random((2, length, 3)),
        random.normal(size=(2, length, 3)),
        random.normal(size=(2, 3)),
    )
    found = scan(*map(torch.tensor, (keep, new, state)))
    for t in range(length):
        state = keep[:, t] * state + new[:, t]
        np.testing.assert_allclose(found[:, t], state, atol=1e-12)


@torch.no_grad()
def test_a_minimal_gru_is_its_equation():
    """h = (1 - z) h + z W x with z = sigmoid(V x)."""
    made, state = cell("mingru")
    found, h = made(X, state)[0], state.numpy()
    (gate, new), (gate_bias, new_bias) = (
        np.split(part.numpy(), 2) for part in (made.linear.weight, made.linear.bias)
    )
    for t, x in enumerate(X.numpy().swapaxes(0, 1)):
        z = sigmoid(x @ gate.T + gate_bias)
        h = (1 - z) * h + z * (x @ new.T + new_bias)
        np.testing.assert_allclose(found[:, t], h, atol=1e-12)


@torch.no_grad()
def test_a_linear_recurrent_unit_is_its_equation():
    """h = a h + sqrt(1 - a^2) i x with a = exp(-softplus(decay) r), gates r and i by sigmoids."""
    made, state = cell("lru")
    found, h = made(X, state)[0], state.numpy()
    weights, biases = (np.split(part.numpy(), 3) for part in (made.linear.weight, made.linear.bias))
    for t, x in enumerate(X.numpy().swapaxes(0, 1)):
        r, i, new = (x @ weight.T + bias for weight, bias in zip(weights, biases, strict=True))
        a = np.exp(-np.log1p(np.exp(made.decay.numpy())) * sigmoid(r))
        h = a * h + np.sqrt(1 - a**2) * sigmoid(i) * new
        np.testing.assert_allclose(found[:, t], h, atol=1e-9)


def test_a_fresh_linear_recurrent_unit_keeps_a_little_or_nearly_all():
    kept = torch.exp(-torch.nn.functional.softplus(CELLS["lru"](5).decay))
    torch.testing.assert_close(kept, torch.linspace(0.9, 0.999, 5))
