"""Window mode takes in each frame once: the last call of a clip gets the frames that are left."""

import pytest
import tiny
import torch

from memmlp.evaluation.modes import predict_frame_by_frame, predict_stream, predict_windows
from memmlp.networks.memory import GRUMemory, LSTMMemory

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
