"""VAE-HMD, part by part."""

import pytest
import tiny
import torch
from torch.distributions import Normal, kl_divergence

from memmlp.motion.body import ROTATION, SPARSE_DIM, SPARSE_VELOCITY
from memmlp.networks import vae_hmd

TRUTH = torch.stack([tiny.clip(7, seed) for seed in (1, 2)])


def learned(pick: float, monkeypatch) -> tuple[vae_hmd.VAEHMD, dict[str, torch.Tensor]]:
    """A network after a training call in which all windows are of true poses (pick 0) or of trackers (1)."""
    model = tiny.baseline("vae_hmd")
    for name, parameter in model.named_parameters():
        if name.endswith("share"):
            parameter.data.fill_(0.5)
    monkeypatch.setattr(torch, "rand_like", lambda like: torch.full_like(like, pick))
    motion, _, losses = model.compute_training_outputs(TRUTH[..., :SPARSE_DIM], {}, TRUTH)
    motion[..., ROTATION].square().sum().backward(retain_graph=True)
    return model, losses


@pytest.mark.parametrize(("pick", "trained"), [(0.0, {"pose_encoder", "decoder"}), (1.0, {"encoder"})])
def test_the_second_stage_leaves_the_decoder_as_it_is(pick, trained, monkeypatch):
    model, _ = learned(pick, monkeypatch)
    slopes = {
        name.split(".")[0]: p.grad
        for name, p in model.named_parameters()
        if p.grad is not None and p.grad.any()
    }
    assert slopes.keys() == trained


@torch.no_grad()
def test_velocities_are_not_seen():
    model, faster = tiny.baseline("vae_hmd"), TRUTH[..., :SPARSE_DIM].clone()
    faster[..., SPARSE_VELOCITY] += 1
    torch.testing.assert_close(model.advance(faster, {})[0], model.advance(TRUTH[..., :SPARSE_DIM], {})[0])


def test_its_loss_is_the_weighted_divergence_of_the_call_which_is_torchs(monkeypatch):
    model, losses = learned(1.0, monkeypatch)
    latent = model.encode(TRUTH[..., :SPARSE_DIM])
    assert losses.keys() == {"divergence"}
    torch.testing.assert_close(losses["divergence"], 0.01 * vae_hmd.compute_divergence(latent))
    latent = torch.randn(3, 4, 10)
    mean, variance = latent.chunk(2, -1)
    expected = kl_divergence(Normal(mean, (0.5 * variance).exp()), Normal(0.0, 1.0)).sum(-1).mean()
    torch.testing.assert_close(vae_hmd.compute_divergence(latent), expected)
