"""AGRoL's networks, part by part."""

import pytest
import tiny
import torch

from memmlp.evaluation import modes as evaluation
from memmlp.motion.body import MOTION_DIM, ROTATION, SPARSE_DIM

CLIP = tiny.clip(40)


@torch.no_grad()
def test_agrol_windows_see_nothing_of_other_windows():
    model, changed = tiny.baseline("agrol_mlp"), CLIP.clone()
    changed[:7] += 0.5
    before, after = (evaluation.predict_windows(model, [clip])[0] for clip in (CLIP, changed))
    assert torch.equal(before[7:], after[7:])
    assert not torch.allclose(before[6], after[6])


def test_a_time_has_a_sine_and_a_cosine_of_each_rate():
    found = tiny.baseline("agrol_diffusion").embed_time(torch.tensor([3]))[0]
    angles = 3 / 10_000 ** (torch.arange(0, len(found), 2) / len(found))
    torch.testing.assert_close(found, torch.stack([angles.sin(), angles.cos()], 1).flatten())


def test_the_denoiser_learns_from_the_noised_truth_of_the_window():
    """The training call gives the denoiser noised true rotations, drawn times and the window's inputs."""
    model, seen = tiny.baseline("agrol_diffusion"), []
    denoise = model.denoise
    model.denoise = lambda *args: (seen.append(args), denoise(*args))[1]
    truth = tiny.clip(7)[None].expand(64, -1, -1)
    state = model.true_state(truth[:, :-1])
    torch.manual_seed(0)
    motion, *_ = model.compute_training_outputs(truth[:, -1:, :SPARSE_DIM], state, truth)
    (noisy, time, encoded), *_ = seen
    frames = model.normalizer.encode(truth)
    signal = model.diffusion.signal[time][:, None, None]
    noise = (noisy - signal.sqrt() * frames[..., SPARSE_DIM:][..., ROTATION]) / (1 - signal).sqrt()
    assert motion.shape == (64, 7, MOTION_DIM)
    torch.testing.assert_close(encoded, frames[..., :SPARSE_DIM])
    assert len(set(time.tolist()) & set(range(50))) > 20
    assert float(noise.std()) == pytest.approx(1, abs=0.02)
