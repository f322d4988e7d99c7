"""Segments, stances and how joints lie in them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from memmlp.motion.body import JOINTS, make_builtin_rest_joints
from memmlp.motion.importing import anatomy
from memmlp.motion.importing.anatomy import HINGES, LIMBS

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


def test_angles_are_accurate() -> None:
    for size in (1e-9, 1.0, np.pi - 1e-6):
        turned = Rotation.from_rotvec([0, 0, size]).apply([1.0, 0, 0])
        assert anatomy.compute_angles(np.array([2.0, 0, 0]), 3 * turned) == pytest.approx(
            np.degrees(size), rel=1e-6
        )


def test_least_rotation_turns_one_direction_onto_another() -> None:
    random = np.random.default_rng(0)
    a, b = anatomy.normalize_vectors(random.normal(size=(2, 50, 3)))
    turn = anatomy.compute_least_rotation(a, b)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", turn, a), b, atol=1e-12)
    own = np.degrees(Rotation.from_matrix(turn).magnitude())
    np.testing.assert_allclose(own, anatomy.compute_angles(a, b), atol=1e-9)
    np.testing.assert_array_equal(anatomy.compute_least_rotation(a[:1] * 0, b[:1]), np.eye(3)[None])


def test_least_rotation_turns_a_direction_onto_its_opposite() -> None:
    """As a bone lies that a file's zero pose has pointing down, and the body pointing up."""
    ways = np.concatenate([np.eye(3), -np.eye(3), [[1, 1, 1], [0.5, -2, 0]]])
    turn = anatomy.compute_least_rotation(ways, -3 * ways)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", turn, ways), -ways, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turn), 1, atol=1e-12)


# Stances


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


def test_the_rest_pose_is_a_stance_whichever_way_it_faces() -> None:
    pose = REST @ Rotation.from_euler("y", 90, degrees=True).as_matrix().T
    assert anatomy.find_stance_fault(pose) is None
    assert anatomy.find_side_fault(pose, ALL) is None
    np.testing.assert_allclose(pose @ anatomy.find_facing_turn(pose).T, REST, atol=1e-12)


@pytest.mark.parametrize(
    ("pose", "said"),
    [
        (turned("pelvis", "x", 90), "pelvis to head points"),
        (turned("spine1", "x", 120), "pelvis to head points"),
        (turned("left_hip", "x", -90), "left_hip to left_knee points"),
        (turned("right_knee", "x", 90), "right_knee to right_ankle points"),
        (turned("left_knee", "x", -40), "left_knee bends forward"),
        (REST * [1, 1, 1] + np.eye(22)[:, [1]] * [0, 0.3, 0], "the hip line is"),
        (REST * 0, "at the same place"),
    ],
)
def test_what_is_no_stance(pose: np.ndarray, said: str) -> None:
    assert said in str(anatomy.find_stance_fault(pose))


def test_wrong_sides() -> None:
    swapped = REST.copy()
    swapped[[16, 17]] = REST[[17, 16]]
    assert "the left shoulder" in str(anatomy.find_side_fault(swapped, ALL))
    assert "the feet point backward" in str(anatomy.find_side_fault(REST * [-1, 1, 1], ALL))
    assert anatomy.find_side_fault(REST * [-1, 1, 1], without("left_foot", "right_foot")) is None


def test_the_straightest_is_the_least_uneven() -> None:
    poses = np.stack([turned("left_knee", "x", 30), REST, turned("spine1", "z", 20)])
    assert anatomy.measure_unevenness(poses).argmin() == 1


# Joints in a stance


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


def test_bends_and_hinges() -> None:
    """Knees and elbows of the body bend about `HINGES`, seen in one pose or in a motion."""
    for joint, axis in HINGES.items():
        middle = LIMBS[joint]
        bends = Rotation.from_rotvec(np.radians([[20.0], [50.0], [70.0]]) * axis).as_matrix()
        positions = np.tile(REST, (3, 1, 1))
        end = LIMBS[middle]
        straight = REST[middle] - REST[joint]
        positions[:, end] = positions[:, middle] + 0.3 * bends @ straight
        upper = np.tile(np.eye(3), (3, 1, 1))
        found = anatomy.find_hinge_axis(upper, positions, joint)
        assert found is not None
        seen = anatomy.find_bend_axis(positions[2], joint)
        assert seen is not None
        for own in (found, seen):
            assert anatomy.compute_angles(own, np.array(axis)) < 15
        positions[:, end] = positions[:, middle] + straight
        assert anatomy.find_hinge_axis(upper, positions, joint) is None
        assert anatomy.find_bend_axis(positions[2], joint) is None
