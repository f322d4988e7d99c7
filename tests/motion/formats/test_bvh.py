"""BVH files: reading, refusals, kinematics against a naive loop, and writing."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bvh_samples import ORDERS, POSITIONS, TREES, person, tree
from plain_kinematics import bvh_positions
from scipy.spatial.transform import Rotation

from memmlp.common.errors import InputError
from memmlp.motion.body import JOINTS, make_builtin_rest_joints
from memmlp.motion.clip import Clip
from memmlp.motion.formats.bvh import MAX_JOINTS, TIPS, compute_euler_zxy, read_bvh, write_bvh
from memmlp.motion.formats.npz import read_clip, write_clip
from memmlp.motion.importing.convert import NONE
from memmlp.motion.importing.import_folder import ImportSettings, import_folder


def write(folder: Path, text: str | bytes) -> Path:
    path = folder / "some clip.bvh"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize("seed", range(4))
def test_trees_and_kinematics_are_those_of_the_text(tmp_path: Path, seed: int) -> None:
    """Of joints with 0 to 6 channels in any order, some of which are moved; by an independent reader."""
    sample, random = tree(list(TREES)[seed % 2]), np.random.default_rng(seed)
    channels = [
        tuple(random.permutation([*POSITIONS, *ORDERS[0]])[: random.integers(7)]) for _ in sample.names
    ]
    values = random.uniform(-300, 300, (1 + seed, sum(map(len, channels)))).round(4)
    sample = replace(sample, channels=channels, values=values)
    path = write(tmp_path, sample.text())
    bvh, expected = read_bvh(path), bvh_positions(path)
    count = len(sample.names)
    assert (bvh.nodes[:count], bvh.node_parents[:count]) == (tuple(sample.names), tuple(sample.parents))
    assert (bvh.channels, set(bvh.nodes)) == (tuple(channels), expected.keys())
    np.testing.assert_array_equal(bvh.offsets[:count], sample.offsets)
    np.testing.assert_array_equal(bvh.values, values)
    for position, name in zip(bvh.compute_kinematics()[1].swapaxes(0, 1), bvh.nodes, strict=True):
        np.testing.assert_allclose(position, expected[name], atol=1e-9)


def test_line_ends_tabs_blanks_case_and_byte_order_mark_may_vary(tmp_path: Path) -> None:
    sample = person("cmu_daz", 3, 1)
    plain, lines = read_bvh(write(tmp_path, sample.text())), sample.text().splitlines()
    mixed = "".join(f"\t {line} \t" + ["\n", "\r\n", "\r", "\n\n"][n % 4] for n, line in enumerate(lines))
    texts = ["\ufeff" + mixed.replace(" ", "\t "), sample.text().replace("\n{", " {")]
    for word in ("HIERARCHY", "OFFSET", "JOINT", "ROOT", "End Site", "MOTION", "CHANNELS", "rotation"):
        texts.append(sample.text().replace(word, word.swapcase()))
    texts += [sample.text(frames=each, time="frametime : {}") for each in ("frames :  {}", "Frames: 00{}")]
    for text in texts:
        bvh = read_bvh(write(tmp_path, text))
        assert (bvh.nodes, bvh.channels) == (plain.nodes, plain.channels)
        np.testing.assert_array_equal(bvh.values, plain.values)


def test_frame_rate(tmp_path: Path) -> None:
    """A rate is rounded to a usual one only as far as the digits of the frame time allow."""
    rates = {
        "0.00833333": 120, "0.0333": 30, "3.33e-2": 30, "0.0417": 24, "0.0167": 60, "0.0083": 120,
        "0.016683": 1 / 0.016683, "0.03337": 1 / 0.03337, "0.03330": 1 / 0.03330,
        "0.0166": 60, "0.0416": 24, "0.016": 62.5, "0.006": 1 / 0.006,
    }  # fmt: skip
    for dt, fps in rates.items():
        assert read_bvh(write(tmp_path, person("cmu_daz", 1, 1).text(dt=dt))).fps == fps, dt


SMALL = """HIERARCHY
ROOT hip
{
OFFSET 0 0 0
CHANNELS 3 Zrotation Xrotation Yrotation
JOINT knee
{
OFFSET 0 -40 0
CHANNELS 1 Xrotation
End Site
{
OFFSET 0 -41 0
}
}
}
MOTION
Frames: 2
Frame Time: 0.01
1 2 3 4
5 6 7 8
"""
DAMAGE = {
    "no hierarchy": ("HIERARCHY", "HIERACHY", "line 1"),
    "no motion": ("MOTION\n", "", "MOTION"),
    "twice a name": ("JOINT knee", "JOINT hip", "line 6"),
    "second end site": ("-41 0\n}", "-41 0\n}\nEnd Site\n{\nOFFSET 0 1 0\n}", "line 14: name 'knee.end'"),
    "no number": ("OFFSET 0 -40 0", "OFFSET 0 forty 0", "'forty'"),
    "seven channels": ("CHANNELS 1", "CHANNELS 7", "'7'"),
    "too few channels": ("CHANNELS 3", "CHANNELS 2", "line 5: 'Yrotation'"),
    "no frames line": ("Frames: 2\n", "", "line 17: 'Frame Time: 0.01'"),
    "no frames": ("Frames: 2", "Frames: 0", "line 17: Frames: '0'"),
    "wrong count": ("Frames: 2", "Frames: 3", "Frames: 3, but 2"),
    "no frame time": ("Frame Time: 0.01\n", "", "Frame Time:"),
    "value missing": ("5 6 7 8", "5 6 7", "line 20: 3 values"),
    "NaN": ("5 6 7 8", "5 6 NaN 8", "line 20: 'NaN'"),
    "no channels": ("3 Zrotation Xrotation Yrotation\n", "0\n", "line 19: 4 values"),
}


def refusal(path: Path) -> str:
    with pytest.raises(InputError, match=rf"^{path}.*\Z") as error:
        read_bvh(path)
    return str(error.value)


def test_damage_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(read_bvh(write(tmp_path, SMALL))) == 2
    for damage, (old, new, said) in DAMAGE.items():
        assert old in SMALL
        assert said in refusal(write(tmp_path, SMALL.replace(old, new, 1))), damage
    assert "0xff" in refusal(write(tmp_path, SMALL.encode().replace(b"knee", b"kn\xffe")))
    assert "0xb2" in refusal(write(tmp_path, SMALL.encode().replace(b" 8", b" \xb2")))
    for content in (np.random.default_rng(0).bytes(5000), b"\0" * 5000, b""):
        refusal(write(tmp_path, content))
    monkeypatch.setattr("memmlp.motion.formats.recording.MAX_BYTES", len(SMALL) - 1)
    assert "too large" in refusal(write(tmp_path, SMALL))


def test_deep_and_wide_hierarchies(tmp_path: Path) -> None:
    def chain(depth: int) -> str:
        joints = "".join(f"JOINT j{n} {{ OFFSET 0 1 0 CHANNELS 0\n" for n in range(depth))
        return SMALL.replace("End Site", joints + "}" * depth + "\nEnd Site")

    assert len(read_bvh(write(tmp_path, chain(MAX_JOINTS - 2))).channels) == MAX_JOINTS
    assert f"{MAX_JOINTS} joints" in refusal(write(tmp_path, chain(MAX_JOINTS - 1)))
    refusal(write(tmp_path, chain(100_000)))


REST = make_builtin_rest_joints()


def there_and_back(folder: Path, clip: Clip, rest: np.ndarray, body: str = "builtin") -> Clip:
    """Return a clip that went from npz to BVH and was imported again."""
    write_clip(folder / "before.npz", clip)
    write_bvh(folder / "clip.bvh", read_clip(folder / "before.npz", "clip"), rest)
    how = ImportSettings(skeleton="memmlp", body=body, floor=NONE)  # nobody stands up in clips of any poses
    import_folder(folder / "clip.bvh", folder / "back", how)
    return read_clip(folder / "back" / "clip.npz", "clip")


def check_same(clip: Clip, back: Clip) -> None:
    """Within 0.1 mm and 0.01 degrees, frame by frame, at the same rate."""
    assert back.fps == pytest.approx(clip.fps, rel=1e-9)
    np.testing.assert_allclose(back.trans, clip.trans, atol=1e-4)
    before, after = (Rotation.from_rotvec(each.poses.reshape(-1, 3)) for each in (clip, back))
    assert np.degrees((before.inv() * after).magnitude()).max() < 0.01


def test_any_pose_comes_back(tmp_path: Path):
    """Of any angles, and of quarters of a turn, which are gimbal locks."""
    random = np.random.default_rng(0)
    angles = random.uniform(-np.pi, np.pi, (60, 22, 3)), random.integers(-1, 3, (60, 22, 3)) * np.pi / 2
    poses = np.where(random.integers(2, size=(60, 22, 3)), *angles)
    for fps in (29.97, 240.0):
        clip = Clip("clip", poses, random.uniform(-20, 20, (60, 3)), fps)
        check_same(clip, there_and_back(tmp_path, clip, REST))


def test_a_body_of_ones_own_comes_back(tmp_path: Path):
    """SMPL's pelvis is not at its origin, and its bones are others."""
    rest = 1.1 * REST + [0.002, -0.24, 0.03]
    tree = np.array([(-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19), range(22)])
    body = {"J_regressor": np.eye(22), "v_template": rest, "kintree_table": tree}
    np.savez(tmp_path / "model.npz", **body)
    random = np.random.default_rng(0)
    clip = Clip("clip", random.normal(size=(20, 22, 3)), random.normal(size=(20, 3)), 60.0)
    check_same(clip, there_and_back(tmp_path, clip, rest, str(tmp_path / "model.npz")))


def test_the_zero_pose_is_the_body_in_centimetres_and_up_is_up(tmp_path: Path):
    write_bvh(tmp_path / "clip.bvh", Clip("clip", np.zeros((2, 22, 3)), np.ones((2, 3)), 60.0), REST)
    bvh = read_bvh(tmp_path / "clip.bvh")
    zero = dict(zip(bvh.nodes, bvh.compute_zero_pose(), strict=True))
    np.testing.assert_allclose([zero[joint] for joint in JOINTS], 100 * REST, atol=1e-5)
    assert set(bvh.nodes[len(JOINTS) :]) == {f"{joint}.end" for joint in TIPS}
    assert bvh.channels[0][:3] == ("Xposition", "Yposition", "Zposition")
    assert {channels[-3:] for channels in bvh.channels} == {("Zrotation", "Xrotation", "Yrotation")}
    assert "Frame Time: 0.016666666667\n" in (tmp_path / "clip.bvh").read_text()
    poses = np.zeros((1, 22, 3))
    poses[0, 0] = [np.pi / 2, 0, 0]
    write_bvh(tmp_path / "clip.bvh", Clip("clip", poses, np.array([[0.5, -2.0, 1.0]]), 60.0), REST)
    rotations, positions = read_bvh(tmp_path / "clip.bvh").compute_kinematics()
    np.testing.assert_allclose(positions[0, 0], [50, 100, 200], atol=1e-5)
    np.testing.assert_allclose(rotations[0], np.broadcast_to(np.eye(3), rotations[0].shape), atol=1e-7)


def test_angles_do_not_jump():
    """Two turns at 3 degrees a frame, past both gimbal locks: halfway between two frames the angles' mean is
    the rotation halfway between them."""
    axis = np.array([1, 0.3, 0.2]) / np.linalg.norm([1, 0.3, 0.2])
    turn = np.radians(np.arange(0, 720, 3) + 0.7)
    matrices = Rotation.from_rotvec(turn[:, None] * axis).as_matrix()
    angles = compute_euler_zxy(matrices[:, None])[:, 0]
    found = Rotation.from_euler("ZXY", angles, degrees=True)
    np.testing.assert_allclose(found.as_matrix(), matrices, atol=1e-12)
    halfway = Rotation.from_euler("ZXY", (angles[1:] + angles[:-1]) / 2, degrees=True)
    expected = Rotation.from_rotvec((turn[1:] + turn[:-1])[:, None] / 2 * axis)
    assert np.degrees((halfway.inv() * expected).magnitude()).max() < 2


def test_names_may_have_blanks(tmp_path: Path):
    text = "HIERARCHY\nROOT Bip01  Pelvis {\nOFFSET 0 0 0\nCHANNELS 1 Xposition\nJoint Bip01 L Thigh\n"
    text += "{ OFFSET 0 1 0\nCHANNELS 0 }\n}\nMOTION\nFrames: 1\nFrame Time: 0.01\n0\n"
    assert read_bvh(write(tmp_path, text)).nodes == ("Bip01  Pelvis", "Bip01 L Thigh")
