"""What is written as BVH is read again as the same motion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from memmlp.motion.body import JOINTS, builtin_rest_joints
from memmlp.motion.clip import Clip
from memmlp.motion.formats.bvh import read_bvh
from memmlp.motion.formats.bvh_writer import TIPS, euler_zxy, write_bvh
from memmlp.motion.formats.npz import read_clip, write_clip
from memmlp.motion.importing.convert import NONE
from memmlp.motion.importing.import_folder import ImportSettings, import_folder
from memmlp.motion.synthetic import synthesize_clip

REST = builtin_rest_joints()
QUARTERS = st.sampled_from([0.0, np.pi / 2, -np.pi / 2, np.pi])  # of a turn: gimbal lock, and no rotation
ANGLES = QUARTERS | st.floats(-np.pi, np.pi)
RATES = st.sampled_from([24.0, 29.97, 30.0, 59.94, 60.0, 100.0, 120.0, 240.0])


@st.composite
def clips(draw: st.DrawFn) -> Clip:
    """Clips of one to four frames with any poses."""
    frames = draw(st.integers(1, 4))
    poses = draw(arrays(np.float64, (frames, 22, 3), elements=ANGLES, fill=QUARTERS))
    trans = draw(arrays(np.float64, (frames, 3), elements=st.floats(-20, 20)))
    return Clip("clip", poses, trans, draw(RATES))


def rotation(clip: Clip) -> Rotation:
    return Rotation.from_rotvec(clip.poses.reshape(-1, 3))


def there_and_back(folder: Path, clip: Clip, rest: np.ndarray, body: str = "builtin") -> Clip:
    """Return a clip that went from npz to BVH and was imported again."""
    write_clip(folder / "before.npz", clip)
    write_bvh(folder / "clip.bvh", read_clip(folder / "before.npz", "clip"), rest)
    how = ImportSettings(skeleton="memmlp", body=body, floor=NONE)  # nobody stands up in clips of any poses
    import_folder(folder / "clip.bvh", folder / "back", how)
    return read_clip(folder / "back" / "clip.npz", "clip")


def check_same(clip: Clip, back: Clip) -> None:
    """Within 0.1 mm and 0.01 degrees, frame by frame, at the same rate."""
    assert len(back) == len(clip)
    assert back.fps == pytest.approx(clip.fps, rel=1e-9)
    assert np.linalg.norm(back.trans - clip.trans, axis=1).max() < 1e-4
    turned = (rotation(clip).inv() * rotation(back)).magnitude()
    assert np.degrees(turned).max() < 0.01


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(clip=clips())
def test_any_pose_comes_back(tmp_path_factory: pytest.TempPathFactory, clip: Clip):
    check_same(clip, there_and_back(tmp_path_factory.mktemp("clip"), clip, REST))


def test_a_body_of_ones_own_comes_back(tmp_path: Path):
    """SMPL's pelvis is not at its origin, and its bones are others."""
    rest = 1.1 * REST + [0.002, -0.24, 0.03]
    tree = np.array([(-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19), range(22)])
    body = {"J_regressor": np.eye(22), "v_template": rest, "kintree_table": tree}
    np.savez(tmp_path / "model.npz", **body)
    random = np.random.default_rng(0)
    clip = Clip("clip", random.normal(size=(20, 22, 3)), random.normal(size=(20, 3)), 60.0)
    check_same(clip, there_and_back(tmp_path, clip, rest, str(tmp_path / "model.npz")))


def test_the_zero_pose_is_the_body_in_centimetres(tmp_path: Path):
    write_bvh(tmp_path / "clip.bvh", Clip("clip", np.zeros((2, 22, 3)), np.ones((2, 3)), 60.0), REST)
    bvh = read_bvh(tmp_path / "clip.bvh")
    zero = dict(zip(bvh.nodes, bvh.zero_pose(), strict=True))
    np.testing.assert_allclose([zero[joint] for joint in JOINTS], 100 * REST, atol=1e-5)
    assert {end.name for end in bvh.ends} == {f"{joint}.end" for joint in TIPS}
    assert bvh.channels[0][:3] == ("Xposition", "Yposition", "Zposition")
    assert {channels[-3:] for channels in bvh.channels} == {("Zrotation", "Xrotation", "Yrotation")}
    assert "Frame Time: 0.016666666667\n" in (tmp_path / "clip.bvh").read_text()


def test_up_is_up(tmp_path: Path):
    """A person who stands upright 2 m ahead (AMASS' -Y) and 1 m up: the file's +Z and +Y."""
    poses = np.zeros((1, 22, 3))
    poses[0, 0] = [np.pi / 2, 0, 0]
    write_bvh(tmp_path / "clip.bvh", Clip("clip", poses, np.array([[0.5, -2.0, 1.0]]), 60.0), REST)
    bvh = read_bvh(tmp_path / "clip.bvh")
    rotations, positions = bvh.kinematics()
    np.testing.assert_allclose(positions[0, 0], [50, 100, 200], atol=1e-5)
    np.testing.assert_allclose(rotations[0], np.broadcast_to(np.eye(3), rotations[0].shape), atol=1e-7)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0.3, 0.2), (0.1, -1, 2)])
def test_angles_do_not_jump(axis: tuple[float, ...]):
    """Two turns at 3 degrees a frame, past both gimbal locks: halfway between two frames the angles' mean is
    the rotation halfway between them."""
    axis = np.array(axis) / np.linalg.norm(axis)
    turn = np.radians(np.arange(0, 720, 3) + 0.7)
    matrices = Rotation.from_rotvec(turn[:, None] * axis).as_matrix()
    angles = euler_zxy(matrices[:, None])[:, 0]
    assert_turns(angles, matrices)
    halfway = Rotation.from_euler("ZXY", (angles[1:] + angles[:-1]) / 2, degrees=True)
    expected = Rotation.from_rotvec((turn[1:] + turn[:-1])[:, None] / 2 * axis)
    assert np.degrees((halfway.inv() * expected).magnitude()).max() < 2


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_about_its_own_axis_an_angle_turns_on(axis: int):
    """Past a quarter of a turn about X too, where the nearer triple is the other one."""
    turn = np.arange(0, 720, 3) + 0.7
    matrices = Rotation.from_rotvec(turn[:, None] * np.eye(3)[axis], degrees=True).as_matrix()
    expected = turn[:, None] * np.eye(3)["ZXY".index("XYZ"[axis])]
    np.testing.assert_allclose(euler_zxy(matrices[:, None])[:, 0], expected, atol=1e-9)


def test_gimbal_lock_loses_nothing():
    random = np.random.default_rng(0)
    angles = np.column_stack(
        [random.uniform(-180, 180, 100), np.tile([90, -90], 50), random.uniform(-180, 180, 100)]
    )
    matrices = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
    assert_turns(euler_zxy(matrices[:, None])[:, 0], matrices)


def assert_turns(angles: np.ndarray, matrices: np.ndarray) -> None:
    np.testing.assert_allclose(
        Rotation.from_euler("ZXY", angles, degrees=True).as_matrix(), matrices, atol=1e-12
    )


def test_nothing_is_left_half_written(tmp_path: Path):
    """A clip that cannot be written leaves the earlier file as it was."""
    path = tmp_path / "clip.bvh"
    path.write_text("before")
    with pytest.raises(ValueError, match="reshape"):
        write_bvh(path, Clip("clip", np.zeros((1, 21, 3)), np.zeros((1, 3)), 60.0), REST)
    assert [file.name for file in tmp_path.iterdir()] == ["clip.bvh"]
    assert path.read_text() == "before"


def test_the_skeleton_is_recognised(tmp_path: Path):
    """As the joints of SMPL that others write too, so that unit and up axis are found in the file."""
    clip = synthesize_clip("walking", 1, seconds=1.0)
    write_bvh(tmp_path / "clip.bvh", clip, REST)
    report = import_folder(tmp_path / "clip.bvh", tmp_path / "back", ImportSettings(floor=NONE))
    assert [(each.skeleton, each.faults) for each in report.clips] == [("smpl_words", ())]
    check_same(clip, read_clip(tmp_path / "back" / "clip.npz", "clip"))
