"""Recordings to clips: segments point as in the file; axes, scale, stances, floors."""

import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bvh_samples import (
    TREES,
    body_rotations,
    own_tree,
    performed,
    random_turns,
    read,
    refuse,
    rest_turns,
    tree,
    write,
)
from scipy.spatial.transform import Rotation

from memmlp.motion.body import JOINTS, make_builtin_rest_joints
from memmlp.motion.clip import Clip
from memmlp.motion.formats.bvh import Bvh, read_bvh
from memmlp.motion.formats.recording import END
from memmlp.motion.geometry import compute_clip_kinematics
from memmlp.motion.importing import convert
from memmlp.motion.importing.anatomy import list_segments
from memmlp.motion.importing.convert import NONE, Conversion, Stance, convert_recording, find_unit_and_up
from memmlp.motion.importing.skeleton_map import Z_UP, SkeletonMap, find_skeleton, load_skeleton, pick_joints
from memmlp.motion.synthetic import synthesize_clip

REST = make_builtin_rest_joints()
JOINT = {name: index for index, name in enumerate(JOINTS)}
DATA = Path(__file__).parents[3] / ".." / "shared" / "data"
CMU = [DATA / "cmu" / name for name in ("salsa/15.bvh", "indian/04.bvh", "martial/03.bvh")]
MM, DEGREES = 1.0, 3.0  # the largest errors that an import may have


def check(path: Path, chosen: SkeletonMap, fps: float = 120.0) -> Conversion:
    """Import a file; the clip must be as in the file."""
    converted = convert_recording(read_bvh(path), chosen, REST, name=path.stem, fps=fps)
    assert converted.fidelity.mm.value < MM
    assert converted.fidelity.degrees.value < DEGREES
    assert [fault for fault in converted.fidelity.faults if "a jump or a cut" not in fault] == []
    return converted


@pytest.mark.slow
@pytest.mark.parametrize("path", CMU, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_cmu_as_in_the_file(tmp_path: Path, path: Path) -> None:
    if not path.is_file():
        pytest.skip("CMU's clips are not here")
    copy = write(tmp_path, path.read_bytes())
    chosen = find_skeleton(read_bvh(copy))
    faults = check(copy, chosen, 60.0 if "salsa" in path.parts else 120.0).fidelity.faults
    assert ["after frame 732" in fault for fault in faults] == [True] * (path.stem == "15")


@pytest.mark.slow
def test_bandai_namco_as_in_the_file(tmp_path: Path) -> None:
    archive = DATA / "bandai-namco" / "bandai-1.tar.xz"
    if not archive.is_file():
        pytest.skip("Bandai-Namco's clips are not here")
    with tarfile.open(archive) as clips:
        member = next(member for member in clips if member.isfile())
        path = write(tmp_path, clips.extractfile(member).read())  # type: ignore[union-attr]
    check(path, load_skeleton("bandai_namco"))


@pytest.fixture(scope="module")
def walk() -> Clip:
    return synthesize_clip("walking", 1, seconds=1.0)


@pytest.mark.parametrize("skeleton", ["bandai_namco", "cmu_daz", "mixamo"])
def test_any_zero_pose_is_as_in_the_file(tmp_path: Path, walk: Clip, skeleton: str) -> None:
    chosen = load_skeleton(skeleton)
    sample = own_tree(chosen)
    given = chosen.rest is not None
    turns = rest_turns(chosen, sample) if given else random_turns(sample, 1)
    path = write(tmp_path, performed(chosen, walk, turns=turns).text())
    converted = check(path, chosen)
    assert ("frame" in converted.fitted.stance.source) == (not given)


DAZ = replace(load_skeleton("cmu_daz"), calibration_frame=False, rest=None)
FOUND = replace(DAZ, unit=None, up=None)


def file(folder: Path, chosen: SkeletonMap, clip: Clip, turned: bool = True) -> Bvh:
    turns = random_turns(own_tree(chosen), 1) if turned else None
    return read_bvh(write(folder, performed(chosen, clip, turns=turns).text()))


def test_unit_and_up_are_found_or_given_and_impossible_units_are_refused(tmp_path: Path, walk: Clip) -> None:
    for unit in convert.UNITS:
        up = "z" if unit < 0.02 else "y"
        settled = find_unit_and_up(file(tmp_path, replace(DAZ, unit=unit, up=up), walk), FOUND)
        assert (settled.unit, settled.up) == (unit, up)
    given = find_unit_and_up(file(tmp_path, DAZ, walk), replace(DAZ, up="z", unit=0.012))
    assert (given.up, given.unit) == ("z", 0.012)
    for unit in (0.3048, 10.0):
        with refuse(tmp_path / "clip.bvh", "the legs are"):
            find_unit_and_up(file(tmp_path, replace(DAZ, unit=unit), walk), FOUND)
    for unit in (1.0, 0.001):
        with refuse(tmp_path / "clip.bvh", f"unit={unit:g}"):
            find_unit_and_up(file(tmp_path, DAZ, walk), replace(DAZ, unit=unit))


def rolled(clip: Clip, *turn: float) -> Clip:
    """A clip whose person is turned about the world's origin by a rotation vector, radians."""
    poses = clip.poses.astype(float)
    poses[:, 0] = (Rotation.from_rotvec(turn) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return replace(clip, poses=poses, trans=np.zeros(clip.trans.shape))


def lying(clip: Clip, side: int = 1) -> Clip:
    """A clip's person, lying with the head along +Z or -Z of Y-up axes."""
    return rolled(clip, side * np.pi / 2, 0.0, 0.0)


FEET = [JOINTS.index("left_foot"), JOINTS.index("right_foot")]


def standing(frames: int) -> np.ndarray:
    """Positions (N, 22, 3) of a person who stands still, the toe joints 2 cm over the floor."""
    positions = REST @ Z_UP.T
    return np.tile(positions + np.array([0, 0, 0.02 - positions[FEET[0], 2]]), (frames, 1, 1))


def test_the_floor_under_who_jumps_lies_or_rises() -> None:
    jumping, rising = standing(100), standing(100)
    jumping[20:80, :, 2] += 0.6 * np.sin(np.linspace(0, np.pi, 60))[:, None]
    assert convert.find_floor(jumping, 60.0) == pytest.approx(0.0, abs=0.01)
    lying = np.tile(REST + np.array([0, 0, 0.1 - REST[:, 2].min()]), (100, 1, 1))  # the head along y, face up
    assert (convert.find_floor(lying, 60.0) or 1) <= 0.1  # below the back, and not below the toes
    rising[..., 2] += np.arange(100)[:, None] / 60
    for positions in (standing(1), standing(5), rising):
        assert convert.find_floor(positions, 60.0) is None


def test_a_t_pose_before_the_motion_is_a_far_step_and_motion_is_none():
    sample = performed(load_skeleton("cmu_daz"), synthesize_clip("waving", 1, seconds=2.0))
    assert convert.measure_first_step(sample.hierarchy()) > convert.JUMP
    assert convert.measure_first_step(replace(sample, values=sample.values[:3]).hierarchy()) == 0.0
    assert convert.measure_first_step(replace(sample, values=sample.values[1:]).hierarchy()) < convert.JUMP


def to_clip(bvh: Bvh, chosen: SkeletonMap, rest: np.ndarray = REST) -> Clip:
    """The clip, its floor as in the file."""
    return convert_recording(bvh, chosen, rest, name="clip", fps=120.0, floor=NONE).clip


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def to_z_up(vectors: np.ndarray) -> np.ndarray:
    return np.stack([vectors[..., 0], -vectors[..., 2], vectors[..., 1]], -1)


@pytest.mark.parametrize("skeleton", TREES)
def test_segments_point_as_in_the_file(tmp_path: Path, skeleton: str) -> None:
    """Exactly, and though the unmapped joints between mapped ones turn too."""
    bvh, chosen = read(tmp_path, skeleton, folded=True), load_skeleton(skeleton)
    positions = to_z_up(bvh.compute_kinematics()[1])[1:]
    body = compute_clip_kinematics(to_clip(bvh, chosen), REST)[1]
    mapped = np.array([name in chosen.joints for name in JOINTS])
    pairs = [segment for segment in list_segments(mapped) if segment.start > 0]
    for joint, child in (*pairs, (JOINT["right_hip"], JOINT["left_hip"])):
        start, end = (bvh.nodes.index(chosen.joints[JOINTS[index]]) for index in (joint, child))
        if np.linalg.norm(bvh.compute_zero_pose()[end] - bvh.compute_zero_pose()[start]) < 1e-6:
            continue
        expected = unit(positions[:, end] - positions[:, start])
        np.testing.assert_allclose(unit(body[:, child] - body[:, joint]), expected, atol=1e-9)


def test_calibration_frame_is_dropped(tmp_path: Path) -> None:
    bvh, chosen = read(tmp_path, "cmu_daz", frames=6), load_skeleton("cmu_daz")
    dropped, kept = to_clip(bvh, chosen), to_clip(bvh, replace(chosen, calibration_frame=False))
    assert (len(dropped), len(kept)) == (5, 6)
    np.testing.assert_array_equal(dropped.poses, kept.poses[1:])
    np.testing.assert_array_equal(dropped.trans, kept.trans[1:])
    for one in (chosen, replace(chosen, up=None)):  # a single frame shows no up axis either
        with refuse(tmp_path / "clip.bvh", "only the calibration frame"):
            to_clip(read(tmp_path, "cmu_daz", frames=1), one)


def test_a_performance_comes_back_from_its_file(tmp_path: Path) -> None:
    """The embedded motion, written as a file of the skeleton: all joints that it has are where they were."""
    clip, chosen, sample = (
        synthesize_clip("reaching", 0, seconds=2.0),
        load_skeleton("cmu_daz"),
        tree("cmu_daz"),
    )
    zero = replace(sample, values=np.zeros((2, sample.values.shape[1]))).hierarchy()
    corrections = convert.fit_skeleton(zero, chosen, REST).corrections
    file = performed(chosen, clip, sample=sample, corrections=corrections)
    bvh = read_bvh(write(tmp_path, file.text("\r\n")))
    found = to_clip(bvh, find_skeleton(bvh))
    assert (len(found), found.fps) == (len(clip), 120)
    known = [joint for joint, name in enumerate(JOINTS) if not chosen.joints.get(name, END).endswith(END)]
    turned = body_rotations(found)[:, known].swapaxes(-1, -2) @ body_rotations(clip)[:, known]
    angles = Rotation.from_matrix(turned.reshape(-1, 3, 3)).magnitude()
    assert np.degrees(angles.max()) < 0.01


ARM = ("collar", "shoulder", "elbow", "wrist")
LEG = ("hip", "knee", "ankle", "foot")


def found(
    folder: Path, clip: Clip, chosen: SkeletonMap, written: SkeletonMap = DAZ, turns: np.ndarray | None = None
) -> Stance:
    """The stance of a file written by one map and read by another."""
    bvh = read_bvh(write(folder, performed(written, clip, turns=turns).text()))
    return convert.find_stance(bvh, chosen, pick_joints(bvh, chosen))


def whole(turn: Rotation) -> np.ndarray:
    """A zero pose turned as a whole."""
    return np.tile(turn.as_matrix(), (len(own_tree(DAZ).names), 1, 1))


def test_a_zero_pose_serves_if_it_stands(tmp_path: Path, walk: Clip) -> None:
    """Whichever way it faces, it is turned to face +Z."""
    lies = found(tmp_path, walk, DAZ, turns=whole(Rotation.from_euler("x", 90, degrees=True)))
    assert lies.source.startswith(convert.STRAIGHTEST)
    assert not lies.untwisted
    stance = found(tmp_path, walk, DAZ, turns=whole(Rotation.from_euler("y", -37, degrees=True)))
    assert (stance.source, stance.untwisted) == ("the zero pose", {1, 2, 16, 17})
    left = stance.positions[1] - stance.positions[2]
    np.testing.assert_allclose(left / np.linalg.norm(left), [1, 0, 0], atol=1e-6)
    assert (stance.positions[10] - stance.positions[7])[2] > 0


def test_a_frame_of_the_file_serves_as_rest(tmp_path: Path, walk: Clip) -> None:
    """A T-pose in frame 0, in a file whose zero pose is not a stance."""
    chosen = replace(DAZ, calibration_frame=True, rest=0)
    bvh = file(tmp_path, chosen, walk)
    done = convert_recording(bvh, chosen, REST, name="clip", fps=120.0, floor=NONE)
    assert (done.fitted.stance.source, done.fidelity.faults) == ("frame 0", ())
    expected = to_clip(file(tmp_path, DAZ, walk, turned=False), DAZ)
    joints = [JOINT[name] for name in ("pelvis", "head", "left_collar", "spine2")]
    np.testing.assert_allclose(done.clip.poses[:, joints], expected.poses[:, joints], atol=1e-5)
    with refuse(tmp_path / "clip.bvh", "rest: frame 999999: must be one of frames 0 to"):
        convert.find_stance(bvh, replace(chosen, rest=999999), pick_joints(bvh, chosen))
    with refuse(tmp_path / "clip.bvh", "rest in skeleton cmu_daz (frame 3) must be an upright stance"):
        found(tmp_path, lying(walk), replace(DAZ, rest=3))


def swapped(chosen: SkeletonMap, parts: tuple[str, ...]) -> SkeletonMap:
    """The map with the left ones of some joints for the right ones."""
    other = {"left": "right", "right": "left"}
    joints = {}
    for joint in chosen.joints:
        side, _, part = joint.partition("_")
        joints[joint] = chosen.joints[f"{other[side]}_{part}" if part in parts else joint]
    return replace(chosen, joints=joints)


def test_swapped_sides_are_refused(tmp_path: Path, walk: Clip) -> None:
    for parts, said in (
        ((*ARM, *LEG), "the feet point backward, so left and right may be swapped"),
        (ARM, "the left shoulder is on the side of the right hip"),
        (LEG, "the left shoulder is on the side of the right hip"),
    ):
        with refuse(tmp_path / "clip.bvh", said):
            found(tmp_path, walk, swapped(DAZ, parts))
    turns = random_turns(own_tree(DAZ), 1)
    with refuse(tmp_path / "clip.bvh", "bends forward, so left and right"):
        found(tmp_path, walk, swapped(DAZ, LEG), turns=turns)
