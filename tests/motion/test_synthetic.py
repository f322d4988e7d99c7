"""The embedded data set: reproducible, in AMASS' layout, and of plausible people."""

import re
from functools import cache

import numpy as np
import pytest
import torch

from memmlp.common.errors import InputError
from memmlp.motion.body import JOINTS, make_builtin_rest_joints
from memmlp.motion.clip import Clip
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.geometry import axis_angle_to_matrix, compute_clip_kinematics, compute_geodesic_angle
from memmlp.motion.synthetic import ACTIVITIES, synthesize, synthesize_clip

FPS = 60.0
BRISK = {"punching": 0.45}  # rad per frame, where a joint may turn faster than elsewhere
JITTER = {"running": 10.0}  # 1e2 m/s^3
LIMITS = {
    "hip": 2.3, "knee": 2.4, "ankle": 1.1, "foot": 0.7, "spine": 0.6, "neck": 0.9, "head": 0.9,
    "collar": 0.6, "shoulder": 2.8, "elbow": 2.6, "wrist": 1.4,
}  # fmt: skip


@cache
def performed(activity: str, seed: int = 0) -> tuple[Clip, np.ndarray, np.ndarray]:
    """Make a clip; return it with its joints' global rotations and positions."""
    made = synthesize_clip(activity, seed, seconds=8.0, fps=FPS)
    clip = Clip(activity, made.poses.astype(float), made.trans.astype(float), FPS)
    return clip, *compute_clip_kinematics(clip, make_builtin_rest_joints())


def joint(positions: np.ndarray, name: str) -> np.ndarray:
    return positions[:, JOINTS.index(name)]


def test_a_seed_gives_the_same_bytes_and_another_gives_others(tmp_path):
    first, again, other = (
        {path.relative_to(tmp_path / name): path.read_bytes() for path in made}
        for name, seed in (("a", 3), ("b", 3), ("c", 4))
        for made in [synthesize(tmp_path / name, minutes=0.5, seed=seed, fps=20.0)]
    )
    assert first == again
    assert not set(first.values()) & set(other.values())


def test_files_are_in_amass_layout_and_last_as_long_as_asked(tmp_path):
    paths = synthesize(tmp_path, minutes=3.0, seed=1, fps=20.0)
    lengths = []
    for path in paths:
        assert re.fullmatch(rf"{path.parent.name}_\d\d\d", path.stem)
        with np.load(path, allow_pickle=False) as file:
            assert set(file.files) == {"poses", "trans", "betas", "gender", "mocap_framerate"}
            assert file["poses"].dtype == file["trans"].dtype == np.float32
            assert file["poses"].shape[1] == 156
        clip = read_clip(path, path.stem)
        assert clip.fps == 20.0
        lengths.append(len(clip))
    assert sum(lengths) == 3 * 60 * 20
    assert min(lengths) > 7 * 20
    assert max(lengths) < 22 * 20
    assert {path.parent.name for path in paths} == set(ACTIVITIES)
    assert len(set(paths)) == len(paths)


def test_a_little_is_three_short_clips_and_bad_arguments_are_named(tmp_path):
    """There is one clip for each part of a split."""
    for seconds in (0.01, 1.0):
        paths = synthesize(tmp_path / str(seconds), minutes=seconds / 60)
        lengths = [len(read_clip(path, path.stem)) for path in paths]
        assert len(lengths) == 3
        assert sum(lengths) == max(6, seconds * 60)
        assert min(lengths) >= max(2, 0.6 / 1.4 * sum(lengths) / 5)
    for key, value in (("minutes", 0.0), ("minutes", float("nan")), ("fps", 0.0), ("fps", 1e9), ("seed", -1)):
        with pytest.raises(InputError, match=f"^{key}="):
            synthesize(tmp_path / "out", **{key: value})
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="activity=flying"):
        synthesize_clip("flying", 0)


@pytest.mark.parametrize("activity", ACTIVITIES)
def test_motion_is_smooth_and_within_the_range_of_a_person(activity):
    clip, rotations, positions = performed(activity)
    for name, angles in zip(JOINTS[1:], np.linalg.norm(clip.poses[:, 1:], axis=2).T, strict=True):
        limit = next(limit for part, limit in LIMITS.items() if part in name)
        assert angles.max() < limit, name
    assert all(joint(clip.poses, f"{side}_knee")[:, 0].min() > 0.0 for side in ("left", "right"))
    assert joint(clip.poses, "left_elbow")[:, 1].max() < 0.0
    assert joint(clip.poses, "right_elbow")[:, 1].min() > 0.0
    assert (joint(positions, "head")[:, 2] > joint(positions, "pelvis")[:, 2] + 0.3).all()
    assert (rotations[:, 0, 2, 1] > 0.3).all()  # the pelvis is upright
    local = axis_angle_to_matrix(torch.from_numpy(clip.poses))
    assert compute_geodesic_angle(local[1:], local[:-1]).max() < BRISK.get(activity, 0.35)
    jitter = np.linalg.norm(np.diff(positions, 3, axis=0), axis=-1).mean() * FPS**3 / 100
    assert jitter < JITTER.get(activity, 5.0)
