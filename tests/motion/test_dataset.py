"""Datasets: stretches of windows, and which windows the sampler draws."""

import pytest
import torch

from memmlp.motion.dataset import MotionDataset, WindowSampler


@pytest.fixture
def frames() -> MotionDataset:
    lengths = torch.tensor([5, 12, 30])
    numbers = torch.arange(47.0)[:, None].expand(-1, 252)
    return MotionDataset(numbers, torch.tensor([0, 5, 17]), lengths, ["a", "b", "c"])


def test_stretches_end_where_asked_and_repeat_the_first_frame(frames):
    stretches = frames.stretches(torch.tensor([0, 1, 2]), torch.tensor([2, 11, 29]), 4)[..., 0]
    assert stretches.tolist() == [[0, 0, 1, 2], [13, 14, 15, 16], [43, 44, 45, 46]]


def test_the_sampler_draws_every_window_alike_and_the_step_is_its_position(frames):
    sampler = WindowSampler(frames, batch=200, window=6, seed=0)
    seen: dict[tuple[int, int], int] = {}
    for step in range(60):
        for pair in zip(*(x.tolist() for x in sampler.draw(step)), strict=True):
            seen[pair] = seen.get(pair, 0) + 1
    possible = {(0, 4)} | {(1, end) for end in range(5, 12)} | {(2, end) for end in range(5, 30)}
    assert set(seen) == possible  # the last windows (2, 29) and (1, 11) among them
    expected = 60 * 200 / len(possible)
    assert all(0.7 * expected < count < 1.3 * expected for count in seen.values())
    again = WindowSampler(frames, batch=200, window=6, seed=0)
    assert all(torch.equal(a, b) for a, b in zip(sampler.draw(7), again.draw(7), strict=True))
    assert not torch.equal(sampler.draw(7)[1], WindowSampler(frames, 200, 6, seed=1).draw(7)[1])
    clips = WindowSampler(frames, batch=3000, window=6, seed=0, drawn_by="clips").draw(0)[0]
    assert torch.bincount(clips).min() > 800
