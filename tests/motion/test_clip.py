"""Clips: exact resampling."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from memmlp.motion.clip import LINES, SPLINES, Clip, resample


def analytic(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Constant turning about a fixed axis and straight motion: what slerp and lerp keep exactly."""
    axis = np.linspace(-1, 1, 66).reshape(22, 3)
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    return axis * (0.8 * times[:, None, None]), times[:, None] * np.array([1.0, -0.5, 0.2])


def turned(poses: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Angles between rotation vectors, radians."""
    one, other = (Rotation.from_rotvec(each.reshape(-1, 3)) for each in (poses, others))
    return (one.inv() * other).magnitude()


@pytest.mark.parametrize(
    ("fps", "how"),
    [(60, "kept"), (240, "every 4. frame"), (100, "interpolated"), (59.94, "interpolated"),
     (30, "interpolated")],
)  # fmt: skip
@pytest.mark.parametrize("interpolation", [SPLINES, LINES])
def test_resampling_is_exact(fps, how, interpolation):
    times = np.arange(int(2 * fps) + 1) / fps
    clip, said = resample(Clip("a", *analytic(times), fps), interpolation=interpolation)
    assert said == how
    assert clip.fps == 60
    wanted = np.arange(len(clip)) / 60
    assert wanted[-1] <= times[-1] < wanted[-1] + 1 / 60 + 1e-9
    poses, trans = analytic(wanted)
    assert turned(clip.poses, poses).max() < 1e-9
    np.testing.assert_allclose(clip.trans, trans, atol=1e-9)


def swinging(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smooth motion that is not steady: joints swing about axes that turn themselves, the body goes round."""
    phases = np.arange(66).reshape(22, 3)
    poses = 0.6 * np.sin(2 * np.pi * 0.9 * times[:, None, None] + phases)
    return poses, 0.5 * np.stack([np.cos(3 * times), np.sin(3 * times), 0.1 * np.sin(9 * times)], 1)


def errors(fps: float, interpolation: str) -> tuple[float, float]:
    """The mean error of swinging motion at 60 Hz, radians, and how much more jerk its translation has."""
    recorded = Clip("a", *swinging(np.arange(int(3 * fps) + 1) / fps), fps)
    clip, _ = resample(recorded, interpolation=interpolation)
    poses, trans = swinging(np.arange(len(clip)) / 60)
    jerk, expected = (np.abs(np.diff(x, 3, axis=0)).mean() for x in (clip.trans, trans))
    return float(turned(clip.poses, poses).mean()), float(jerk / expected)


@pytest.mark.parametrize("fps", [24, 30, 100])
def test_splines_are_nearer_to_smooth_motion_than_lines_and_have_its_jerk(fps):
    (splines, jerk), (lines, kinks) = (errors(fps, name) for name in (SPLINES, LINES))
    assert splines < 0.2 * lines
    assert abs(jerk - 1) < 0.15
    assert kinks > (3 if fps <= 30 else 1.4)


def test_pieces_are_the_clip():
    poses, trans = analytic(np.arange(7.0))
    for frames, lengths in ((3, [3, 3, 1]), (7, [7]), (100, [7])):
        pieces = list(Clip("clip", poses, trans, 60.0).split_into_pieces(frames))
        assert [len(piece) for piece in pieces] == lengths
        np.testing.assert_array_equal(np.concatenate([piece.poses for piece in pieces]), poses)
        np.testing.assert_array_equal(np.concatenate([piece.trans for piece in pieces]), trans)
