"""Attention, encoder layers, and the weights that AvatarPoser and the networks made from it start with."""

import torch
from torch import nn

from memmlp.networks.transformer import Attention, DiTBlock


@torch.no_grad()
def test_attention_is_torchs_with_the_same_weights():
    attention, h = Attention(8, 2).double(), torch.randn(3, 5, 8, dtype=torch.float64)
    torchs = nn.MultiheadAttention(8, 2, batch_first=True).double()
    parts = attention.query, attention.key, attention.value
    torchs.in_proj_weight.copy_(torch.cat([part.weight for part in parts]))
    torchs.in_proj_bias.copy_(torch.cat([part.bias for part in parts]))
    torchs.out_proj.load_state_dict(attention.out.state_dict())
    torch.testing.assert_close(attention(h), torchs(h, h, h)[0])


@torch.no_grad()
def test_a_block_is_an_independent_computation():
    block, draw = DiTBlock(6, 2).double(), torch.Generator().manual_seed(0)
    x, time = (torch.randn(*shape, generator=draw).double() for shape in ((1, 5, 6), (1, 6)))

    def normed(x: torch.Tensor) -> torch.Tensor:
        return (x - x.mean(-1, keepdim=True)) / (x.var(-1, correction=0, keepdim=True) + 1e-6).sqrt()

    found = block.modulation(time).chunk(6, -1)
    made = block(x, time)
    x = x + found[2] * block.attention(normed(x) * (1 + found[1]) + found[0])
    hidden = nn.functional.gelu(block.mlp[0](normed(x) * (1 + found[4]) + found[3]), approximate="tanh")
    torch.testing.assert_close(made, x + found[5] * block.mlp[2](hidden))
