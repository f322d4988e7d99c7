"""The counted operations are those of the products, whichever kernel computes them."""

from __future__ import annotations

import pytest
import tiny
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.backends import mha

from memmlp.deploy.latency import macs
from memmlp.motion.body import MOTION_DIM, SPARSE_DIM
from memmlp.networks.flop_counter import counting_flops
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.recurrent_memory import LSTM
from memmlp.networks.streaming import streaming

T, WIDTH, HEADS, INNER = 7, 16, 4, 32
PROJECTIONS, SCORES = 4 * T * WIDTH * WIDTH, 2 * T * T * WIDTH
ATTENTION = PROJECTIONS + SCORES
MIXERS = {
    "TransformerEncoder": 2 * (ATTENTION + 2 * T * WIDTH * INNER),
    "MultiheadAttention": ATTENTION,
    "scaled_dot_product_attention": SCORES,
}


class Attentive(MotionModel):
    """A network as a user writes it, with torch's own attention between two linear layers."""

    def __init__(self, mixer: str):
        super().__init__(tiny.normalizer(), T)
        self.mixer = mixer
        self.stem, self.head = nn.Linear(SPARSE_DIM, WIDTH), nn.Linear(WIDTH, MOTION_DIM)
        layer = nn.TransformerEncoderLayer(WIDTH, HEADS, INNER, dropout=0.0, batch_first=True)
        self.encoder = nn.TransformerEncoder(layer, 2)
        self.attention = nn.MultiheadAttention(WIDTH, HEADS, batch_first=True)

    def mixed(self, x: Tensor) -> Tensor:
        """Mix features (B, T, WIDTH) in time."""
        if self.mixer == "TransformerEncoder":
            return self.encoder(x)
        if self.mixer == "MultiheadAttention":
            return self.attention(x, x, x, need_weights=False)[0]
        if self.mixer == "none":
            return x
        heads = x.unflatten(-1, (HEADS, -1)).transpose(1, 2)
        return F.scaled_dot_product_attention(heads, heads, heads).transpose(1, 2).flatten(2)

    def advance(self, sparse, state, newest=None):
        """Return the motion of the window's newest frames, and the state."""
        inputs, state = self.append_inputs(sparse, state)
        made = self.head(self.mixed(self.stem(inputs[:, -T:])))
        return made[:, -(newest or T) :], state


@pytest.mark.parametrize("mixer", MIXERS)
def test_torchs_own_attention_is_counted(mixer: str):
    """In evaluation it is one kernel, which torch's counter takes for nothing."""
    assert macs(Attentive(mixer).eval()) == T * WIDTH * (SPARSE_DIM + MOTION_DIM) + MIXERS[mixer]
    assert mha.get_fastpath_enabled()


def test_an_lstms_gradients_are_counted():
    """Its backward pass is one kernel, which torch's counter does not know."""
    layer = LSTM(6)
    inputs = torch.randn(3, 5, 54, requires_grad=True)
    with counting_flops() as counter:
        output, _ = layer(inputs, [torch.zeros(3, 6), torch.zeros(3, 6)])
        forward = counter.get_total_flops()
        output.sum().backward()
    assert forward == 2 * 3 * 5 * 24 * (54 + 6)
    assert counter.get_total_flops() == 3 * forward


def test_a_warning_names_products_without_a_formula_once(capsys: pytest.CaptureFixture[str]):
    for _ in range(2):
        with counting_flops():
            nn.Bilinear(3, 3, 4)(torch.randn(2, 3), torch.randn(2, 3))
            torch.lgamma(torch.ones(2)), F.interpolate(torch.ones(1, 1, 3), scale_factor=2, mode="linear")
    assert capsys.readouterr().err.count("_trilinear") == 1


def test_every_product_of_the_networks_has_a_formula(capsys: pytest.CaptureFixture[str]):
    for model in (tiny.model(), *map(tiny.baseline, tiny.BASELINES)):
        assert macs(model.eval()) > 0
        assert macs(streaming(model).eval()) > 0
        assert capsys.readouterr().err == ""
