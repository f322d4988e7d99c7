"""The weights that AvatarPoser and the networks made from it begin with."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from memmlp.config.build import untrained
from memmlp.networks.transformer import Attention, draw_weights

EMBEDDING = (".query", ".key", ".value")


def linear_layers(name: str) -> dict[str, nn.Linear]:
    model = untrained(["profile=small", f"model={name}"]).requires_grad_(False)
    return {at: layer for at, layer in model.named_modules() if isinstance(layer, nn.Linear)}


@pytest.mark.parametrize("name", ["avatar_poser", "ego_poser", "manikin_s", "manikin_l", "avatar_jlm"])
def test_they_are_small_and_without_biases(name: str):
    """In units of each layer's own deviation all weights together are a standard normal distribution's."""
    layers = linear_layers(name)
    drawn = {at: layer for at, layer in layers.items() if not at.endswith(EMBEDDING)}
    assert len(drawn) >= 8
    units = [layer.weight.flatten() * (layer.in_features / 2) ** 0.5 / 0.2 for layer in drawn.values()]
    assert float(torch.cat(units).std()) == pytest.approx(1, abs=0.02)
    for at, layer in layers.items():
        assert not layer.bias.any(), at
        if at in drawn and layer.weight.numel() > 2_000:
            expected = 0.2 * (2 / layer.in_features) ** 0.5
            assert float(layer.weight.std()) == pytest.approx(expected, rel=0.1), at


def test_attention_s_are_those_of_torch_s_own_layer():
    """Compared by spread and largest value, for both are drawn."""
    torch.manual_seed(0)
    ours, theirs = (layer(256, 8).requires_grad_(False) for layer in (Attention, nn.MultiheadAttention))
    draw_weights(ours)
    for part in (ours.query, ours.key, ours.value):
        assert float(part.weight.std()) == pytest.approx(float(theirs.in_proj_weight.std()), rel=0.02)
        assert float(part.weight.abs().max()) == pytest.approx(
            float(theirs.in_proj_weight.abs().max()), rel=0.01
        )
    assert len({float(part.weight[0, 0]) for part in (ours.query, ours.key, ours.value)}) == 3


def test_other_networks_keep_torch_s():
    assert all(layer.bias.any() for layer in linear_layers("hmd_poser").values())
