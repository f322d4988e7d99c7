"""Window mode takes in each frame once: the last call of a clip gets the frames that are left."""

import pytest
import tiny
import torch

from memmlp.evaluation.modes import (
    count_frames_per_call,
    mixes_clips,
    predict,
    predict_frame_by_frame,
    predict_stream,
    predict_windows,
)
from memmlp.networks.memory import GRUMemory, LSTMMemory, NoMemory
from memmlp.networks.motion_model import WindowlessModel

CLIPS = [tiny.clip(n, seed=n).double() for n in (25, 5, 20, 16)]  # windows of 7 or 8


@pytest.mark.parametrize("name", ["avatar_poser", "sage"])
@torch.no_grad()
def test_networks_that_make_each_frame_from_the_window_that_ends_with_it_are_the_same_in_both_modes(name):
    model = tiny.baseline(name).double()
    for streamed, windowed in zip(predict_stream(model, CLIPS), predict_windows(model, CLIPS), strict=True):
        torch.testing.assert_close(windowed, streamed, atol=1e-9, rtol=0)


@pytest.mark.parametrize("memory", [LSTMMemory, GRUMemory])
@torch.no_grad()
def test_a_recurrent_memory_runs_over_each_frame_once(memory):
    model = tiny.model(memory).double()
    expected = predict_frame_by_frame(model, CLIPS, model.frames)
    for windowed, one in zip(predict_windows(model, CLIPS), expected, strict=True):
        torch.testing.assert_close(windowed, one, atol=1e-9, rtol=0)


MODELS = {
    "recurrent_poser": tiny.recurrent_poser, "vq": tiny.model, "none": lambda: tiny.model(NoMemory),
}  # fmt: skip
BASELINES = ["hmd_poser", "rpm", "vae_hmd", "avatar_poser", "agrol_mlp", "sage"]


@pytest.mark.parametrize("name", [*MODELS, *BASELINES])
@torch.no_grad()
def test_several_frames_in_a_call_are_the_same_stream(name):
    model = (MODELS[name]() if name in MODELS else tiny.baseline(name)).double()
    assert model.frames_per_call >= 6
    model.frames_per_call = 6
    assert count_frames_per_call(model, CLIPS[0][None, :, :54]) == 6
    several = predict_stream(model, CLIPS)
    model.frames_per_call = 1
    for made, expected in zip(several, predict_stream(model, CLIPS), strict=True):
        torch.testing.assert_close(made, expected, atol=1e-9, rtol=0)


class SeesLaterFrames(WindowlessModel):
    """A network that averages the frames of a call, so its results depend on the size of the calls."""

    def advance(self, sparse, state, newest=None):
        return sparse.mean(1, keepdim=True).repeat(1, sparse.shape[1], 4)[..., :198], state


def test_a_network_that_would_see_later_frames_gets_one_frame_per_call():
    model = SeesLaterFrames(tiny.normalizer(), 7)
    assert count_frames_per_call(model, CLIPS[0][None, :, :54]) == 1
    (motion,) = predict_stream(model, CLIPS[:1])
    torch.testing.assert_close(motion[:, :54], CLIPS[0][:, :54])


class MixesClips(WindowlessModel):
    """A network that subtracts the mean of its batch, like a normalisation over the wrong dimension."""

    def advance(self, sparse, state, newest=None):
        return (sparse - sparse.mean(0)).repeat(1, 1, 4)[..., :198], state


def test_a_network_that_mixes_clips_gets_one_at_a_time_and_the_checks_draw_no_random_numbers():
    model = MixesClips(tiny.normalizer(), 7)
    assert all(motion.abs().max() < 1e-6 for motion in predict(model, CLIPS, "stream", 4))
    sampled = tiny.model(blend="sampled").double()
    before = torch.get_rng_state()
    assert not mixes_clips(sampled, CLIPS)
    assert count_frames_per_call(sampled, CLIPS[0][None, :, :54]) == 1
    assert torch.equal(torch.get_rng_state(), before)
