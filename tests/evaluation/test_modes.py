"""Window mode takes in each frame once: the last call of a clip gets the frames that are left."""

import pytest
import tiny
import torch

from memmlp.evaluation.modes import (
    can_join_frames,
    mixes_clips,
    predict,
    predict_frame_by_frame,
    predict_stream,
    predict_windows,
)
from memmlp.networks.agrol import AGRoLMLP
from memmlp.networks.memory import GRUMemory, LSTMMemory, NoMemory
from memmlp.networks.motion_model import WindowlessModel, WindowModel
from memmlp.networks.own_past_memory import MemoryWithoutCodes

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
def test_several_frames_in_a_call_are_the_same_stream(name, monkeypatch):
    model = (MODELS[name]() if name in MODELS else tiny.baseline(name)).double()
    counts, advance_frames = [], type(model).advance_frames

    def spied(self, sparse, state):
        counts.append(sparse.shape[1])
        return advance_frames(self, sparse, state)

    monkeypatch.setattr(type(model), "advance_frames", spied)
    several = predict_stream(model, CLIPS)
    assert max(counts) >= 6
    monkeypatch.setattr(type(model), "frames_per_call", 1)
    for made, expected in zip(several, predict_stream(model, CLIPS), strict=True):
        torch.testing.assert_close(made, expected, atol=1e-9, rtol=0)
    assert counts[-1] == 1


def test_an_evaluation_has_no_more_windows_in_a_call_than_clips_in_a_batch(monkeypatch):
    model, sizes = tiny.model(NoMemory).double(), []
    advance = model.advance

    def spied(sparse, state, newest=None):
        sizes.append(len(sparse))
        return advance(sparse, state, newest)

    monkeypatch.setattr(model, "advance", spied)
    predict(model, CLIPS[:1], "stream", 1)
    assert max(sizes) == 1
    predict(model, CLIPS[:1], "stream", 5)
    assert max(sizes) == 5


@pytest.mark.parametrize("base", [WindowlessModel, AGRoLMLP, NoMemory, MemoryWithoutCodes])
def test_a_part_with_its_own_computation_gets_one_frame_per_call(base):
    """Except without a window, where several frames are the interface."""

    class Own(base):
        def advance(self, sparse, state, newest=None):
            return super().advance(sparse, state, newest)

        def recall(self, sparse, state, new):
            return super().recall(sparse, state, new)

    assert Own.frames_per_call == (256 if base is WindowlessModel else 1)


class SeesLaterFrames(WindowlessModel):
    """A network that averages the frames of a call, so its results depend on the size of the calls."""

    def advance(self, sparse, state, newest=None):
        return sparse.mean(1, keepdim=True).repeat(1, sparse.shape[1], 4)[..., :198], state


def test_a_network_that_would_see_later_frames_gets_one_frame_per_call():
    model = SeesLaterFrames(tiny.normalizer(), 7)
    assert not can_join_frames(model, CLIPS[0][None, :, :54], 8)
    (motion,) = predict_stream(model, CLIPS[:1])
    torch.testing.assert_close(motion[:, :54], CLIPS[0][:, :54])


class MixesWindows(WindowModel):
    """A network that subtracts the mean of its batch, in which a stream has several windows of a clip."""

    def predict_rotations(self, encoded):
        return (encoded - encoded.mean(0)).repeat(1, 1, 3)[..., :132]


def test_a_network_that_mixes_windows_gets_one_at_a_time_even_if_the_person_stands_still_first():
    model, clip = MixesWindows(tiny.normalizer(), 7).double(), CLIPS[0].clone()
    clip[:12] = clip[:1]
    (motion,) = predict_stream(model, [clip])
    assert motion[:, 6:132].std(0).max() < 1e-9


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
    assert not can_join_frames(sampled, CLIPS[0][None, :, :54], 7)
    assert torch.equal(torch.get_rng_state(), before)
