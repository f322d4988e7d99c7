"""Attention, encoder layers, and the weights that AvatarPoser and the networks made from it start with."""

from __future__ import annotations

from math import erf, pi, sqrt

import numpy as np
import pytest
import torch
from torch import nn

from memmlp.config.build import build_untrained
from memmlp.networks.transformer import Attention, DiTBlock

EMBEDDING = (".query", ".key", ".value")


def linear_layers(name: str) -> dict[str, nn.Linear]:
    model = build_untrained(["profile=small", f"model={name}"]).requires_grad_(False)
    return {at: layer for at, layer in model.named_modules() if isinstance(layer, nn.Linear)}


def test_they_are_small_and_without_biases():
    """In units of each layer's own deviation all weights together are a standard normal distribution's."""
    for name in ("avatar_poser", "ego_poser", "manikin_s", "manikin_l", "avatar_jlm"):
        layers = linear_layers(name)
        drawn = {at: layer for at, layer in layers.items() if not at.endswith(EMBEDDING)}
        assert len(drawn) >= 8
        units = [layer.weight.flatten() * (layer.in_features / 2) ** 0.5 / 0.2 for layer in drawn.values()]
        assert float(torch.cat(units).std()) == pytest.approx(1, abs=0.02)
        assert not any(layer.bias.any() for layer in layers.values()), name
    assert all(layer.bias.any() for layer in linear_layers("hmd_poser").values())


@torch.no_grad()
def test_attention_is_an_independent_computation():
    """Frame by frame and head by head, in NumPy; and the same as torch's own with the same weights."""
    attention, h = Attention(8, 2).double(), torch.randn(3, 5, 8, dtype=torch.float64)

    def linear(layer, x):
        return x @ layer.weight.numpy().T + layer.bias.numpy()

    expected = np.zeros((3, 5, 8))
    for b, x in enumerate(h.numpy()):
        query, key, value = (linear(of, x) for of in (attention.query, attention.key, attention.value))
        for t in range(5):
            for part in (slice(0, 4), slice(4, 8)):
                scores = np.array([query[t, part] @ key[s, part] / 2.0 for s in range(5)])
                share = np.exp(scores) / np.exp(scores).sum()
                expected[b, t, part] = sum(share[s] * value[s, part] for s in range(5))
    found = attention(h).numpy()
    np.testing.assert_allclose(found, linear(attention.out, expected), atol=1e-12)


@torch.no_grad()
def test_a_block_is_an_independent_numpy_computation():
    block, draw = DiTBlock(6, 2).double(), torch.Generator().manual_seed(0)
    h, time = (torch.randn(*shape, generator=draw).double() for shape in ((1, 5, 6), (1, 6)))

    def linear(layer: torch.nn.Linear, x: np.ndarray) -> np.ndarray:
        return x @ layer.weight.numpy().T + layer.bias.numpy()

    def normed(x: np.ndarray) -> np.ndarray:
        return (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-6)

    def gelu(x: np.ndarray) -> np.ndarray:
        return 0.5 * x * (1 + np.tanh(sqrt(2 / pi) * (x + 0.044715 * x**3)))

    x, found = h[0].numpy(), np.split(linear(block.modulation, time[0].numpy()), 6)
    seen = normed(x) * (1 + found[1]) + found[0]
    attended = block.attention(torch.tensor(seen)[None])[0].numpy()
    x = x + found[2] * attended
    hidden = gelu(linear(block.mlp[0], normed(x) * (1 + found[4]) + found[3]))
    np.testing.assert_allclose(block(h, time)[0].numpy(), x + found[5] * linear(block.mlp[2], hidden))
    assert abs(gelu(np.array(1.0)) - (1 + erf(1 / sqrt(2))) / 2) < 1e-3
