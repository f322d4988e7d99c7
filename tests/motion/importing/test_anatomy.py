"""Segments, stances and how joints lie in them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from memmlp.motion.body import JOINTS, make_builtin_rest_joints
from memmlp.motion.importing import anatomy

REST = make_builtin_rest_joints()
ALL = np.ones(len(JOINTS), bool)
JOINT = {name: index for index, name in enumerate(JOINTS)}


def without(*names: str) -> np.ndarray:
    return np.array([name not in names for name in JOINTS])


def test_segments_go_on_past_joints_that_are_missing() -> None:
    assert len(anatomy.list_segments(ALL)) == 17
    names = [str(segment) for segment in anatomy.list_segments(without("spine3", "neck", "left_foot"))]
    assert "spine2 to head" in names
    assert not [name for name in names if "left_foot" in name]


def test_angles_and_least_rotations_are_accurate() -> None:
    for size in (1e-9, 1.0, np.pi - 1e-6):
        turned = 3 * Rotation.from_rotvec([0, 0, size]).apply([1.0, 0, 0])
        found = anatomy.compute_angles(np.array([2.0, 0, 0]), turned)
        assert found == pytest.approx(np.degrees(size), rel=1e-6)
    random = np.random.default_rng(0)
    a, b = anatomy.normalize_vectors(random.normal(size=(2, 50, 3)))
    ways = np.concatenate([np.eye(3), -np.eye(3), [[1, 1, 1], [0.5, -2, 0]]])
    for start, end in ((a, b), (ways, -ways)):
        turn = anatomy.compute_least_rotation(start, 3 * end)
        np.testing.assert_allclose(np.einsum("nij,nj->ni", turn, start), end, atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(turn), 1, atol=1e-12)
        angles = np.degrees(Rotation.from_matrix(turn).magnitude())
        np.testing.assert_allclose(angles, anatomy.compute_angles(start, end), atol=1e-5)
    np.testing.assert_array_equal(anatomy.compute_least_rotation(a[:1] * 0, b[:1]), np.eye(3)[None])


def turned(joint: str, axis: str, degrees: float) -> np.ndarray:
    """The rest pose with what is below a joint turned about it."""
    pose, index = REST.copy(), JOINT[joint]
    below = [index]
    for child, parent in enumerate(anatomy.PARENTS):
        if parent in below:
            below.append(child)
    turn = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    pose[below] = pose[index] + (pose[below] - pose[index]) @ turn.T
    return pose


def test_stances_face_any_way_and_left_is_left() -> None:
    pose = REST @ Rotation.from_euler("y", 90, degrees=True).as_matrix().T
    assert anatomy.find_stance_fault(pose) is None
    assert anatomy.find_side_fault(pose, ALL) is None
    np.testing.assert_allclose(pose @ anatomy.find_facing_turn(pose).T, REST, atol=1e-12)
    swapped = REST.copy()
    swapped[[16, 17]] = REST[[17, 16]]
    assert "the left shoulder" in str(anatomy.find_side_fault(swapped, ALL))
    assert "the feet point backward" in str(anatomy.find_side_fault(REST * [-1, 1, 1], ALL))
    assert anatomy.find_side_fault(REST * [-1, 1, 1], without("left_foot", "right_foot")) is None
    poses = np.stack([turned("left_knee", "x", 30), REST, turned("spine1", "z", 20)])
    assert anatomy.measure_unevenness(poses).argmin() == 1


@pytest.mark.parametrize(("pose", "said"), [
    (turned("pelvis", "x", 90), "pelvis to head points"),
    (turned("spine1", "x", 120), "pelvis to head points"),
    (turned("left_hip", "x", -90), "left_hip to left_knee points"),
    (turned("right_knee", "x", 90), "right_knee to right_ankle points"),
    (turned("left_knee", "x", -40), "left_knee bends forward"),
    (REST + np.eye(22)[:, [1]] * [0, 0.3, 0], "the hip line is"),
    (REST * 0, "at the same place"),
])  # fmt: skip
def test_what_is_no_stance(pose: np.ndarray, said: str) -> None:
    assert said in str(anatomy.find_stance_fault(pose))


@pytest.mark.parametrize("mapped", [ALL, without("spine3"), without("neck", "left_collar", "spine1")])
def test_every_segment_points_as_in_the_stance(mapped: np.ndarray) -> None:
    stance = turned("left_shoulder", "z", -60)
    stance[JOINT["right_wrist"]] += [0.1, -0.1, 0.05]
    stance[JOINT["left_knee"]] += [0.0, 0.02, 0.06]
    own = anatomy.compute_orientations(stance, mapped, REST)
    for start, end in anatomy.list_segments(mapped):
        if start > 0:
            there = stance[end] - stance[start]
            assert anatomy.compute_angles(own[start] @ (REST[end] - REST[start]), there) < 1e-6
