"""AvatarPoser, part by part."""

import numpy as np
import tiny
import torch

from memmlp.evaluation import modes as evaluation
from memmlp.motion.body import SPARSE_DIM
from memmlp.networks.transformer import Attention, EncoderLayer

CLIP = tiny.clip(40)
SPARSE = CLIP[None, :, :SPARSE_DIM]


@torch.no_grad()
def test_avatar_poser_is_the_same_in_both_modes():
    """Every frame has its own window, so a clip of whole windows is the same in both."""
    model = tiny.baseline("avatar_poser")
    clip = CLIP[: 5 * model.frames]
    torch.testing.assert_close(evaluation.window(model, [clip])[0], evaluation.stream(model, [clip])[0])


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
def test_avatar_poser_reads_the_newest_frame_and_knows_no_order_of_the_others():
    model, window = tiny.baseline("avatar_poser").double(), torch.randn(1, 7, SPARSE_DIM).double()
    found = model.rotations(window)
    torch.testing.assert_close(model.rotations(window[:, [3, 1, 5, 0, 2, 4, 6]]), found)
    assert not torch.allclose(model.rotations(window[:, [6, 1, 2, 3, 4, 5, 0]]), found, atol=1e-3)


@torch.no_grad()
def test_the_encoder_layer_is_torchs():
    layer, torchs = EncoderLayer(8, 2, 16, 0.1).eval(), torch.nn.TransformerEncoderLayer(8, 2, 16).eval()
    parts = [layer.attention.query, layer.attention.key, layer.attention.value]
    torchs.self_attn.in_proj_weight.copy_(torch.cat([part.weight for part in parts]))
    torchs.self_attn.in_proj_bias.copy_(torch.cat([part.bias for part in parts]))
    pairs = [
        (torchs.self_attn.out_proj, layer.attention.out), (torchs.linear1, layer.widen),
        (torchs.linear2, layer.narrow), (torchs.norm1, layer.attention_norm), (torchs.norm2, layer.norm),
    ]  # fmt: skip
    for theirs, ours in pairs:
        theirs.load_state_dict(ours.state_dict())
    h = torch.randn(5, 3, 8)
    torch.testing.assert_close(layer(h.transpose(0, 1)), torchs(h).transpose(0, 1), atol=1e-5, rtol=0)


def test_dropout_drops_in_training_alone():
    model = tiny.baseline("avatar_poser", dropout=0.5)
    call = SPARSE[:, :7], model.initial_state(1), CLIP[None, :7]
    assert torch.equal(model.training_call(*call)[0], model.training_call(*call)[0])
    model.train()
    assert not torch.equal(model.training_call(*call)[0], model.training_call(*call)[0])
