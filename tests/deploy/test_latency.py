"""Times and sizes of a step, and the network alone, which computes what the network does."""

from functools import partial

import pytest
import tiny
import torch
import torch.nn.functional as F
from torch import nn

from memmlp.deploy import latency
from memmlp.deploy.latency import count_macs, strip_conversions
from memmlp.motion.body import MOTION_DIM, POSITION, ROTATION, SPARSE_DIM
from memmlp.motion.network_coordinates import World
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.memory import NoMemory
from memmlp.networks.motion_model import MotionModel


@pytest.mark.parametrize("make", [
    tiny.model, partial(tiny.baseline, "manikin_s"), lambda: tiny.refined(tiny.recurrent_poser()),
])  # fmt: skip
@torch.no_grad()
def test_without_conversions_it_is_the_same_network(make):
    """In the world's coordinates, without z-scores, features are the world's inputs."""
    model = make()
    for module in model.modules():
        if isinstance(module, Normalizer):
            module.coordinates = World()
            module.mean.zero_(), module.std.fill_(1)
    alone = strip_conversions(model)
    clip = tiny.clip(4)[None, :, :SPARSE_DIM]
    ours, theirs = model.initial_state(), alone.initial_state()
    for t in range(clip.shape[1]):
        whole, ours = model.advance(clip[:, t : t + 1], ours, 1)
        bare, theirs = alone.advance(clip[:, t : t + 1], theirs, 1)
        torch.testing.assert_close(bare[..., ROTATION], whole[..., ROTATION], atol=1e-5, rtol=1e-5)
        assert "position" in model.branches or not bare[..., POSITION].any(), "kinematics are not timed"
    assert count_macs(alone) <= count_macs(model)


@pytest.mark.slow
def test_latency_and_size(naive_step, small_yardstick, monkeypatch):
    model, path = naive_step
    measured = latency.measure_step_times(path, steps=1)
    assert measured["steps"] == 200
    assert 0 < measured["median_ms"] <= measured["p95_ms"]
    assert measured["ratio_to_yardstick"] > 0
    assert 0 < measured["core_share"] < 1.01
    size = latency.measure_size(model, model, path)
    assert size["flops"] == 2 * size["macs"] > 0
    assert size["onnx_bytes"] == path.stat().st_size
    clock = iter([5.0, 5.0 + 1e-9])  # a thread without a core
    monkeypatch.setattr(latency.time, "thread_time", lambda: next(clock))
    assert latency.measure_step_times(path, steps=1)["core_share"] < 1e-6


def test_macs_are_counted_by_hand():
    model = tiny.model(NoMemory)
    frames, hidden = model.frames, model.hidden
    block = frames * frames * hidden + frames * hidden * hidden
    newest = frames * hidden + hidden * hidden  # the branches' last block makes the newest frame alone
    expected = frames * 54 * hidden + 4 * block + 2 * newest + hidden * (132 + 66)
    with torch.no_grad():
        assert latency.count_macs(model) == expected


class Attentive(MotionModel):
    """A network as a user writes it, with torch's own attention between two linear layers."""

    def __init__(self, mixer: str):
        super().__init__(tiny.normalizer(), 7)
        self.mixer = mixer
        self.stem, self.head = nn.Linear(SPARSE_DIM, 16), nn.Linear(16, MOTION_DIM)
        layer = nn.TransformerEncoderLayer(16, 4, 32, dropout=0.0, batch_first=True)
        self.encoder = nn.TransformerEncoder(layer, 2)

    def advance(self, sparse, state, newest=None):
        inputs, state = self.append_inputs(sparse, state)
        h = self.stem(inputs[:, -7:])
        if self.mixer == "encoder":
            h = self.encoder(h)
        else:
            heads = h.unflatten(-1, (4, -1)).transpose(1, 2)
            h = F.scaled_dot_product_attention(heads, heads, heads).transpose(1, 2)
        return self.head(h.flatten(2)), state


@pytest.mark.parametrize("mixer", ["encoder", "attention"])
def test_products_of_torchs_own_attention_are_counted(mixer: str):
    """In evaluation an encoder is one kernel, of which torch's counter counts nothing."""
    scores = 2 * 7 * 7 * 16
    inner = 2 * (4 * 7 * 16 * 16 + scores + 2 * 7 * 16 * 32) if mixer == "encoder" else scores
    assert count_macs(Attentive(mixer).eval()) == 7 * 16 * (SPARSE_DIM + MOTION_DIM) + inner
