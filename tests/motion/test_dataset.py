"""Datasets: stretches of windows, and which windows the sampler draws."""

import re

import numpy as np
import pytest
import tiny
import torch
from plain_body import posed

from memmlp.motion.body import FRAME_DIM, JOINTS, ROTATION, SPARSE_DIM
from memmlp.motion.dataset import MirroredDataset, MotionDataset, WindowSampler, mirror_frames
from memmlp.motion.geometry import compute_motion_frames


@pytest.fixture
def frames() -> MotionDataset:
    lengths = torch.tensor([5, 12, 30])
    numbers = torch.arange(47.0)[:, None].expand(-1, 252)
    return MotionDataset(numbers, torch.tensor([0, 5, 17]), lengths, ["a", "b", "c"])


def test_stretches_end_where_asked_and_repeat_the_first_frame(frames):
    stretches = frames.read_stretches(torch.tensor([0, 1, 2]), torch.tensor([2, 11, 29]), 4)[..., 0]
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
    long = tiny.frames((105, 55, 14))  # 100, 50 and 9 windows
    long.groups = ["a", "a", "b"]
    drawn = torch.bincount(WindowSampler(long, 9000, 6, seed=0, drawn_by="groups").draw(0)[0]) / 9000
    roots = 150**0.5, 9**0.5
    a, b = (root / sum(roots) for root in roots)
    assert drawn.tolist() == pytest.approx([a * 2 / 3, a / 3, b], abs=0.02)


CLIP = tiny.clip(20)


TWINS = [
    JOINTS.index("".join({"left": "right", "right": "left"}.get(one, one) for one in re.split("(_)", name)))
    for name in JOINTS
]


def test_joints_of_the_mirrored_rotations_are_the_mirrored_joints():
    """By forward kinematics joint by joint, in NumPy."""
    for frame, other in zip(CLIP[::6], mirror_frames(CLIP)[::6], strict=True):
        body, seen = (posed(one[SPARSE_DIM:][ROTATION].numpy()) for one in (frame, other))
        np.testing.assert_allclose(seen, body[TWINS] * [-1, 1, 1], atol=1e-5)


def test_it_is_what_a_person_of_mirrored_angles_gives():
    """Axis-angle (x, y, z) is (x, -y, -z) in the mirror; all 252 features of that person are compared."""
    random = np.random.default_rng(3)
    poses, trans = random.normal(size=(6, 22, 3)), random.normal(size=(6, 3))
    pairs = ((poses, trans), (poses[:, TWINS] * [1, -1, -1], trans * [-1, 1, 1]))
    plain, expected = (
        compute_motion_frames(torch.tensor(turns), torch.tensor(moved), tiny.REST.double())
        for turns, moved in pairs
    )
    assert plain.shape[-1] == FRAME_DIM
    torch.testing.assert_close(mirror_frames(plain), expected, atol=1e-9, rtol=0)


def test_a_mirrored_dataset_has_each_clip_twice_and_its_frames_once():
    plain = tiny.frames((30, 20))
    both = MirroredDataset(plain)
    assert both.frames is plain.frames
    assert both.names == ["clip0", "clip1", "clip0 (mirrored)", "clip1 (mirrored)"]
    assert both.groups == [*plain.groups, *plain.groups]
    for index, clip in enumerate(both.read_clips()):
        expected = plain.read_clip(index % 2)
        assert torch.equal(clip, mirror_frames(expected) if index > 1 else expected)
    drawn = both.read_stretches(torch.arange(4), torch.full((4,), 9), 5)
    for index, segment in enumerate(drawn):
        expected = plain.read_clip(index % 2)[5:10]
        assert torch.equal(segment, mirror_frames(expected) if index > 1 else expected)


@pytest.mark.parametrize("drawn_by", ["frames", "clips"])
def test_half_of_the_windows_are_mirrored(drawn_by):
    both = MirroredDataset(tiny.frames((30, 20)))
    clips, _ = WindowSampler(both, 4000, 7, 0, drawn_by).draw(0)
    assert float((clips >= 2).float().mean()) == pytest.approx(0.5, abs=0.03)
