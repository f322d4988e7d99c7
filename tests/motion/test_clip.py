"""Clips: exact resampling."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from memmlp.motion.clip import Clip, resample


def analytic(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Constant turning about a fixed axis and straight motion: what slerp and lerp keep exactly."""
    axis = np.linspace(-1, 1, 66).reshape(22, 3)
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    return axis * (0.8 * times[:, None, None]), times[:, None] * np.array([1.0, -0.5, 0.2])


@pytest.mark.parametrize(
    ("fps", "how"),
    [(60, "kept"), (120, "every 2. frame"), (240, "every 4. frame"), (100, "interpolated"),
     (59.94, "interpolated"),
     (250, "interpolated"), (150, "interpolated"), (30, "interpolated"), (50, "interpolated")],
)  # fmt: skip
def test_resampling_is_exact(fps, how):
    times = np.arange(int(2 * fps) + 1) / fps
    clip, said = resample(Clip("a", *analytic(times), fps))
    assert said == how
    assert clip.fps == 60
    wanted = np.arange(len(clip)) / 60
    assert wanted[-1] <= times[-1] < wanted[-1] + 1 / 60 + 1e-9
    poses, trans = analytic(wanted)
    ours, expected = (Rotation.from_rotvec(p.reshape(-1, 3)) for p in (clip.poses, poses))
    assert (ours.inv() * expected).magnitude().max() < 1e-9
    np.testing.assert_allclose(clip.trans, trans, atol=1e-9)


@pytest.mark.parametrize(("frames", "lengths"), [(3, [3, 3, 1]), (7, [7]), (100, [7])])
def test_parts_are_the_clip(frames: int, lengths: list[int]):
    poses, trans = analytic(np.arange(7.0))
    parts = list(Clip("clip", poses, trans, 60.0).parts(frames))
    assert [len(part) for part in parts] == lengths
    np.testing.assert_array_equal(np.concatenate([part.poses for part in parts]), poses)
    np.testing.assert_array_equal(np.concatenate([part.trans for part in parts]), trans)
