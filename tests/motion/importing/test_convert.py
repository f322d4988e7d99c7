"""Whole imports beside the text of their files, posed by plain NumPy: real families and turned zero poses."""

from __future__ import annotations

import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bvh_samples import own_tree, performed, random_turns, refuse, rest_turns, write
from plain_kinematics import bvh_positions, to_world, worst_direction, worst_distance
from scipy.spatial.transform import Rotation
from skeleton_families import walking as walking_sample

from memmlp.motion.body import JOINTS, builtin_rest_joints
from memmlp.motion.clip import Clip
from memmlp.motion.formats.bvh import Bvh, read_bvh
from memmlp.motion.formats.npz import write_clip
from memmlp.motion.geometry import clip_kinematics
from memmlp.motion.importing.convert import (
    JUMP,
    UNITS,
    Converted,
    StanceView,
    convert,
    find_floor,
    find_unit_and_up,
    first_step,
    view_stance,
)
from memmlp.motion.importing.skeleton_map import (
    Z_UP,
    SkeletonMap,
    find_skeleton,
    load_skeleton,
    shipped_skeletons,
)
from memmlp.motion.synthetic import synthesize_clip

REST = builtin_rest_joints()
DATA = Path(__file__).parents[3] / ".." / "shared" / "data"
CMU = [DATA / "cmu" / name for name in ("salsa/15.bvh", "indian/04.bvh", "martial/03.bvh")]
BANDAI = DATA / "bandai-namco" / "bandai-1.tar.xz"
MM, DEGREES = 1.0, 3.0  # the largest errors that an import may have


def imported(path: Path, chosen: SkeletonMap) -> Converted:
    return convert(read_bvh(path), chosen, REST, name=path.stem)


def check(path: Path, chosen: SkeletonMap, unit: float, up: str) -> Converted:
    """Import a file, and compare what is kept with the file's text."""
    converted = imported(path, chosen)
    npz = path.with_suffix(".npz")
    write_clip(npz, converted.clip)
    first = int(chosen.calibration_frame)
    file = {name: to_world(places[first:], up) for name, places in bvh_positions(path).items()}
    joints = dict(chosen.joints)
    assert worst_direction(npz, file, joints)[0] < DEGREES
    assert worst_distance(npz, file, joints, unit)[0] < MM
    return converted


# The data's own files


@pytest.mark.slow
@pytest.mark.parametrize("path", CMU, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_cmu_as_in_the_file(tmp_path: Path, path: Path) -> None:
    if not path.is_file():
        pytest.skip("CMU's clips are not here")
    copy = write(tmp_path, path.read_bytes())
    chosen = find_skeleton(read_bvh(copy))
    assert check(copy, chosen, 0.01, "y").fidelity.faults == ()


@pytest.mark.slow
def test_bandai_namco_as_in_the_file(tmp_path: Path) -> None:
    if not BANDAI.is_file():
        pytest.skip("Bandai-Namco's clips are not here")
    with tarfile.open(BANDAI) as archive:
        members = [member for _, member in zip(range(40), archive, strict=False) if member.isfile()]
        paths = [write(tmp_path, archive.extractfile(m).read(), Path(m.name).name) for m in members[::13]]  # type: ignore[union-attr]
    assert len(paths) >= 3
    for path in paths:
        assert check(path, load_skeleton("bandai_namco"), 0.01, "y").fidelity.faults == ()


# Zero poses turned at random


@pytest.fixture(scope="module")
def walking() -> Clip:
    return synthesize_clip("walking", 1, seconds=1.5)


@pytest.mark.parametrize("skeleton", shipped_skeletons())
def test_any_zero_pose_is_as_in_the_file(tmp_path: Path, walking: Clip, skeleton: str) -> None:
    chosen = load_skeleton(skeleton)
    sample = own_tree(chosen)
    given = isinstance(chosen.rest, dict)
    turns = rest_turns(chosen, sample) if given else random_turns(sample, 1)
    path = write(tmp_path, performed(chosen, walking, turns=turns).text())
    converted = check(path, chosen, chosen.unit or 0.01, chosen.up or "y")
    assert converted.fidelity.faults == ()
    assert ("frame" in converted.stance) == (not given)


@pytest.mark.parametrize("skeleton", ["cmu_daz", "mixamo"])
def test_the_zero_pose_does_not_matter(tmp_path: Path, walking: Clip, skeleton: str) -> None:
    """Where both are read from the same frame."""
    chosen = replace(load_skeleton(skeleton), rest=20)
    plain = write(tmp_path, performed(chosen, walking).text(), "plain.bvh")
    turns = random_turns(own_tree(chosen), 5)
    turned = write(tmp_path, performed(chosen, walking, turns=turns).text(), "turned.bvh")
    expected, found = imported(plain, chosen).clip, imported(turned, chosen).clip
    np.testing.assert_allclose(found.trans, expected.trans, atol=1e-6)
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-5)


# Units and up axes: told, found, or refused


TOLD = replace(load_skeleton("cmu_daz"), calibration_frame=False)
FOUND = replace(TOLD, unit=None, up=None)


@pytest.fixture(scope="module")
def walk() -> Clip:
    return synthesize_clip("walking", 1, seconds=1.0)


def file(folder: Path, chosen: SkeletonMap, clip: Clip, turned: bool = True) -> Bvh:
    turns = random_turns(own_tree(chosen), 1) if turned else None
    return read_bvh(write(folder, performed(chosen, clip, turns=turns).text()))


@pytest.mark.parametrize("unit", UNITS)
def test_unit_and_up_are_found(tmp_path: Path, walk: Clip, unit: float) -> None:
    up = "z" if unit < 0.02 else "y"
    settled = find_unit_and_up(file(tmp_path, replace(TOLD, unit=unit, up=up), walk), FOUND)
    assert (settled.unit, settled.up) == (unit, up)


def test_what_is_told_counts(tmp_path: Path, walk: Clip) -> None:
    assert find_unit_and_up(file(tmp_path, TOLD, walk), replace(TOLD, up="z", unit=0.012)).up == "z"
    assert find_unit_and_up(file(tmp_path, TOLD, walk), replace(TOLD, up="z", unit=0.012)).unit == 0.012


@pytest.mark.parametrize("unit", [0.3048, 10.0])
def test_an_unknown_unit_is_refused(tmp_path: Path, walk: Clip, unit: float) -> None:
    with refuse(tmp_path / "clip.bvh", "the legs are"):
        find_unit_and_up(file(tmp_path, replace(TOLD, unit=unit), walk), FOUND)


@pytest.mark.parametrize("unit", [1.0, 0.001])
def test_a_wrong_unit_is_refused(tmp_path: Path, walk: Clip, unit: float) -> None:
    with refuse(tmp_path / "clip.bvh", f"unit={unit:g}"):
        find_unit_and_up(file(tmp_path, TOLD, walk), replace(TOLD, unit=unit))


@pytest.mark.parametrize("axis", ["x", "-y"])
def test_another_up_axis_is_refused(tmp_path: Path, walk: Clip, axis: str) -> None:
    turn = {"x": [0.0, np.pi / 2, 0.0], "-y": [np.pi, 0.0, 0.0]}[axis]
    poses = walk.poses.astype(float)
    poses[:, 0] = (Rotation.from_rotvec(turn) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    with refuse(tmp_path / "clip.bvh", "no up axis found"):
        find_unit_and_up(file(tmp_path, TOLD, replace(walk, poses=poses)), FOUND)


def lying(clip: Clip, head: str) -> Clip:
    """Turn a clip's person down to lie with the head along an axis of Y-up axes."""
    turn = {"z": [np.pi / 2, 0.0, 0.0], "x": [0.0, np.pi / 2, 0.0], "-z": [-np.pi / 2, 0.0, 0.0]}[head]
    poses, trans = clip.poses.astype(float), np.zeros(clip.trans.shape)
    poses[:, 0] = (Rotation.from_rotvec(turn) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return replace(clip, poses=poses, trans=trans)


@pytest.mark.parametrize(("up", "head"), [("y", "-z"), ("z", "x")])
def test_who_lies_in_a_file_whose_zero_pose_stands_lies(
    tmp_path: Path, walk: Clip, up: str, head: str
) -> None:
    chosen = replace(TOLD, up=up)
    assert find_unit_and_up(file(tmp_path, chosen, lying(walk, head), turned=False), FOUND).up == up


def test_a_zero_pose_and_a_motion_of_two_minds_are_refused(tmp_path: Path, walk: Clip) -> None:
    """It may be a person who lies, or one who walks while only the root's rotation has Z up."""
    bvh = file(tmp_path, TOLD, lying(walk, "z"), turned=False)
    with refuse(tmp_path / "clip.bvh", "stands along y in the zero pose", "along z in the motion", "--up y"):
        find_unit_and_up(bvh, FOUND)
    assert [find_unit_and_up(bvh, replace(FOUND, up=up)).up for up in "yz"] == ["y", "z"]
    upside_down = lying(lying(walk, "z"), "z")
    with refuse(tmp_path / "clip.bvh", "no up axis found"):
        find_unit_and_up(file(tmp_path, TOLD, upside_down, turned=False), FOUND)


# The floor under people who stand, climb, jump, lie and fly


REST = builtin_rest_joints()
FEET = [JOINTS.index("left_foot"), JOINTS.index("right_foot")]


def standing(frames: int) -> np.ndarray:
    """Positions (N, 22, 3) of a person who stands still, the toe joints 2 cm over the floor."""
    positions = REST @ Z_UP.T
    return np.tile(positions + np.array([0, 0, 0.02 - positions[FEET[0], 2]]), (frames, 1, 1))


@pytest.mark.parametrize("activity", ["walking", "jumping", "sitting"])
@pytest.mark.parametrize("height", [1.3])
def test_the_floor_of_people(activity: str, height: float) -> None:
    clip = synthesize_clip(activity, 2, seconds=4.0)
    positions = clip_kinematics(replace(clip, poses=clip.poses.astype(float)), REST)[1]
    found = find_floor(positions + np.array([0, 0, height]), 60.0)
    assert found == pytest.approx(height, abs=0.02)


def test_the_lowest_step_of_stairs() -> None:
    positions = standing(400)
    positions[..., 2] += np.repeat([0.0, 0.2, 0.4, 0.6], 100)[:, None]
    assert find_floor(positions, 60.0) == pytest.approx(0.0, abs=1e-9)
    assert find_floor(positions[::-1], 60.0) == pytest.approx(0.0, abs=1e-9)


def test_a_jump_does_not_raise_the_floor() -> None:
    positions = standing(100)
    positions[20:80, :, 2] += 0.6 * np.sin(np.linspace(0, np.pi, 60))[:, None]
    assert find_floor(positions, 60.0) == pytest.approx(0.0, abs=0.01)


def test_who_lies_is_on_the_floor() -> None:
    """On the back, the toes up: the floor isn't below the toes but below the back."""
    lying = REST  # the head along y, the face up
    positions = np.tile(lying + np.array([0, 0, 0.1 - lying[:, 2].min()]), (100, 1, 1))
    found = find_floor(positions, 60.0)
    assert found is not None
    assert found <= 0.1


def test_no_floor_without_contact() -> None:
    positions = standing(100)
    assert find_floor(positions[:1], 60.0) is None
    assert find_floor(positions[:5], 60.0) is None
    positions[..., 2] += np.arange(100)[:, None] / 60
    assert find_floor(positions, 60.0) is None


# A first frame that is no motion is told by how far it is from the next


@pytest.mark.parametrize("activity", ["walking", "waving"])
def test_a_t_pose_before_the_motion_is_a_far_step_and_motion_is_none(activity: str):
    sample = performed(load_skeleton("cmu_daz"), synthesize_clip(activity, 1, seconds=2.0))
    assert first_step(sample.hierarchy()) > JUMP
    assert first_step(replace(sample, values=sample.values[1:]).hierarchy()) < JUMP


def test_what_is_short_or_hardly_moves_has_none():
    sample = performed(load_skeleton("cmu_daz"), synthesize_clip("walking", 1, seconds=2.0))
    assert first_step(replace(sample, values=sample.values[:3]).hierarchy()) == 0.0
    nearly = np.repeat(sample.values[5:6], 9, 0)
    nearly[0, 8] += 0.5
    assert first_step(replace(sample, values=nearly).hierarchy()) == 0.0


# The stance that is shown: the one that importing reads, with all nodes, and the body as it stands alike


REST = builtin_rest_joints()


def stance(folder: Path, name: str, turned: bool) -> StanceView:
    bvh = read_bvh(write(folder, walking_sample(name, turned).text()))
    return view_stance(bvh, find_skeleton(bvh), REST)


@pytest.mark.parametrize(
    ("name", "turned", "source"),
    [("mixamo", False, "zero pose"), ("lafan1", True, "straightest"), ("cmu_daz", False, "zero pose")],
)
def test_the_body_stands_as_the_file_does(tmp_path: Path, name: str, turned: bool, source: str):
    found = stance(tmp_path, name, turned)
    assert source in found.source
    assert found.positions.shape == (len(found.nodes), 3)
    for start, end in (("left_hip", "left_knee"), ("right_elbow", "right_wrist"), ("neck", "head")):
        there = found.positions[found.mapped[end]] - found.positions[found.mapped[start]]
        here = found.body[JOINTS.index(end)] - found.body[JOINTS.index(start)]
        assert there @ here > 0.999 * np.linalg.norm(there) * np.linalg.norm(here)
    hips = found.positions[found.mapped["left_hip"]] - found.positions[found.mapped["right_hip"]]
    assert hips[0] > 0
    assert abs(hips[2]) < 1e-6
