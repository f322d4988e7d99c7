"""BVH -> Clip: fidelity on both skeletons, axes, maps, frame rates, damaged files, whole folders."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from bvh_samples import FOLDED, TREES, mutate, person
from scipy.spatial.transform import Rotation

from memmlp.body import JOINTS, builtin_rest_joints
from memmlp.data.bvh import Bvh, read_bvh
from memmlp.data.clip import Clip, read_clip
from memmlp.data.fidelity import verify, verify_folder
from memmlp.data.importing import import_folder
from memmlp.data.retarget import FOLLOWERS, fit, retarget
from memmlp.data.skeleton import LIMBS, SKELETONS, find_skeleton, load_skeleton, shipped_skeletons
from memmlp.errors import InputError
from memmlp.geometry import axis_angle_to_matrix, forward_kinematics

REST = builtin_rest_joints()
CMU = Path(__file__).parents[2] / ".." / "shared" / "data" / "cmu"
CLIPS = ("indian/13", "martial/04", "salsa/10", "salsa/25")
JOINT = {name: index for index, name in enumerate(JOINTS)}


def write(folder: Path, text: str | bytes, name: str = "clip.bvh") -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def read(folder: Path, skeleton: str, frames: int = 5, **options: int) -> Bvh:
    return read_bvh(write(folder, person(skeleton, frames, **{"seed": 3, **options}).text()))


def on_body(clip: Clip) -> tuple[np.ndarray, np.ndarray]:
    """Global rotations (N, 22, 3, 3) and positions (N, 22, 3) on the built-in body."""
    rest = torch.from_numpy(REST)
    root = rest[0] + torch.from_numpy(clip.trans)
    rotations, positions = forward_kinematics(axis_angle_to_matrix(torch.from_numpy(clip.poses)), root, rest)
    return rotations.numpy(), positions.numpy()


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def to_z_up(vectors: np.ndarray) -> np.ndarray:
    return np.stack([vectors[..., 0], -vectors[..., 2], vectors[..., 1]], -1)


@contextmanager
def refuse(start: Path | str, *said: str) -> Iterator[None]:
    """Expect an InputError of one line that begins with `start` and has what is said."""
    with pytest.raises(InputError) as error:
        yield
    message = str(error.value)
    assert message.startswith(str(start))
    assert len(message.splitlines()) == 1
    for part in (*said, "; allowed: "):
        assert part in message


# Fidelity


@pytest.mark.parametrize("skeleton", TREES)
def test_imports_keep_joints_and_limbs(tmp_path: Path, skeleton: str) -> None:
    path = write(tmp_path, person(skeleton, 40, 5).text())
    fidelity = verify(path)
    assert (fidelity.skeleton, fidelity.frames) == (skeleton, 39)
    assert fidelity.worst_mm < 0.01
    assert fidelity.worst_degrees < 0.001


@pytest.mark.parametrize("skeleton", TREES)
def test_limbs_point_as_in_the_file(tmp_path: Path, skeleton: str) -> None:
    """Independent of `verify`, and with the unmapped joints between mapped ones turning too."""
    bvh, chosen = read(tmp_path, skeleton, folded=True), load_skeleton(skeleton)
    positions = to_z_up(bvh.kinematics()[1])[1:]
    body = on_body(retarget(bvh, chosen, REST))[1]
    for joint, child in LIMBS.items():
        start, end = (bvh.nodes.index(chosen.joints[JOINTS[index]]) for index in (joint, child))
        expected = unit(positions[:, end] - positions[:, start])
        np.testing.assert_allclose(unit(body[:, child] - body[:, joint]), expected, atol=1e-9)


@pytest.mark.parametrize("skeleton", TREES)
def test_unmapped_rotations_are_folded_in(tmp_path: Path, skeleton: str) -> None:
    """Head and torso turn in the world as in the file, whatever joints lie between."""
    bvh, chosen = read(tmp_path, skeleton, folded=True), load_skeleton(skeleton)
    assert any(name in FOLDED for name in bvh.names)
    source = bvh.kinematics()[0][1:]
    body = on_body(retarget(bvh, chosen, REST))[0]
    for joint in ("pelvis", "spine1", "spine2", "neck", "head", "left_collar"):
        node = source[:, bvh.nodes.index(chosen.joints[joint])]
        expected = to_z_up(node.swapaxes(-1, -2)).swapaxes(-1, -2)
        np.testing.assert_allclose(body[:, JOINT[joint]], expected, atol=1e-9)


def test_a_turning_joint_without_counterpart_shows(tmp_path: Path) -> None:
    """The check is no tautology: a buttock that turns moves the thigh on a bone the import has not."""
    assert verify(write(tmp_path, person("cmu_daz", 10, 5, folded=True).text())).worst_mm > 1


def test_verify_notices_a_wrong_import(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def bent(*args: object, **options: object) -> Clip:
        clip = retarget(*args, **options)  # type: ignore[arg-type]
        clip.poses[:, JOINT["left_elbow"]] *= 0.9
        return clip

    path = write(tmp_path, person("cmu_daz", 10, 5).text())
    monkeypatch.setattr("memmlp.data.fidelity.retarget", bent)
    assert verify(path).worst_mm > 1
    assert verify(path).worst_joint == "left_wrist"
    assert verify(path).worst_degrees > 1


def test_verify_reads_the_npz(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def shifted(path: Path, name: str) -> Clip:
        clip = read_clip(path, name)
        return replace(clip, trans=clip.trans + 0.01)

    monkeypatch.setattr("memmlp.data.fidelity.read_clip", shifted)
    assert verify(write(tmp_path, person("cmu_daz", 10, 5).text())).worst_mm > 10


def test_joints_without_counterpart_do_not_turn(tmp_path: Path) -> None:
    clip = retarget(read(tmp_path, "cmu_daz"), load_skeleton("cmu_daz"), REST)
    np.testing.assert_allclose(clip.poses[:, JOINT["spine3"]], 0, atol=1e-9)
    assert np.abs(clip.poses[:, JOINT["spine2"]]).max() > 0.1


def test_another_body_keeps_limbs_too(tmp_path: Path) -> None:
    rest = REST * [1.2, 0.8, 1.1] + [0.1, -0.2, 0.3]
    rest[JOINT["left_elbow"], 1] -= 0.1
    bvh, chosen = read(tmp_path, "cmu_daz"), load_skeleton("cmu_daz")
    clip = retarget(bvh, chosen, rest)
    local, tensor = axis_angle_to_matrix(torch.from_numpy(clip.poses)), torch.from_numpy(rest)
    body = forward_kinematics(local, tensor[0] + torch.from_numpy(clip.trans), tensor)[1].numpy()
    positions = to_z_up(bvh.kinematics()[1])[1:]
    start, end = bvh.nodes.index("lShldr"), bvh.nodes.index("lForeArm")
    hips = [bvh.nodes.index("lThigh"), bvh.nodes.index("rThigh")]
    middle = positions[:, hips].mean(1) * chosen.unit * fit(bvh, chosen, rest).scale
    np.testing.assert_allclose(body[:, [1, 2]].mean(1), middle, atol=1e-9)
    arm = body[:, JOINT["left_elbow"]] - body[:, JOINT["left_shoulder"]]
    np.testing.assert_allclose(unit(arm), unit(positions[:, end] - positions[:, start]), atol=1e-9)


# Axes, scale, calibration


@pytest.mark.parametrize("skeleton", TREES)
def test_a_standing_person_stands(tmp_path: Path, skeleton: str) -> None:
    """The file's zero pose, on the file's floor: upright in z, facing -y, left on +x, soles on the floor."""
    sample = person(skeleton, 2, 0)
    sample.values[:] = 0
    bvh, chosen = read_bvh(write(tmp_path, sample.text())), load_skeleton(skeleton)
    toes = bvh.zero_pose()[[bvh.nodes.index(chosen.joints[foot]) for foot in ("left_foot", "right_foot")], 1]
    sample.values[:, 1] = -toes.mean()
    clip = retarget(read_bvh(write(tmp_path, sample.text())), chosen, REST)
    at = dict(zip(JOINTS, on_body(clip)[1][0], strict=True))
    assert 1.3 < at["head"][2] < 1.7
    assert 0.7 < at["pelvis"][2] - at["left_ankle"][2] < 1.0
    assert abs(at["left_foot"][2]) < 0.06
    assert at["left_wrist"][0] > 0.5 and at["right_wrist"][0] < -0.5  # noqa: PT018
    assert at["left_foot"][1] < at["left_ankle"][1] - 0.05
    rotations = np.linalg.norm(clip.poses[0], axis=-1)
    assert rotations[JOINT["pelvis"]] == pytest.approx(np.pi / 2)
    assert np.degrees(rotations[1:]).max() < 35
    np.testing.assert_allclose(rotations[list(FOLLOWERS)], 0, atol=1e-9)  # straight wrists, level soles


def test_left_is_left_of_facing(tmp_path: Path) -> None:
    """A person who has turned by 90 degrees about the file's up axis faces +x, with the left on +y."""
    sample = person("cmu_daz", 2, 0)
    sample.values[:] = 0
    turn = 3 + [name[0] for name in sample.channels[0][3:]].index("Y")
    sample.values[1, turn] = 90
    rotations, positions = on_body(
        retarget(read_bvh(write(tmp_path, sample.text())), load_skeleton("cmu_daz"), REST)
    )
    facing = rotations[0, 0] @ [0, 0, 1]
    left = unit(positions[0, JOINT["left_wrist"]] - positions[0, JOINT["right_wrist"]])
    np.testing.assert_allclose(facing, [1, 0, 0], atol=1e-9)
    assert np.cross([0, 0, 1], facing) @ left > 0.99


def test_up_axis(tmp_path: Path) -> None:
    """The same motion in a Z-up file gives the same clip."""
    sample, chosen = person("cmu_daz", 6, 2), load_skeleton("cmu_daz")
    expected = retarget(read_bvh(write(tmp_path, sample.text())), chosen, REST)
    moved, values = replace(sample), sample.values.copy()
    moved.offsets = to_z_up(np.array(sample.offsets)).tolist()
    moved.ends = [(joint, to_z_up(np.array(offset)).tolist()) for joint, offset in sample.ends]
    values[:, :3] = to_z_up(values[:, :3])
    column, channels = 3, []
    for names in sample.channels:
        rotations = [name for name in names if name.endswith("rotation")]
        for name in rotations:  # a turn about y is one about z, a turn about z one about -y
            values[:, column] *= -1 if name[0] == "Z" else 1
            column += 1
        renamed = [{"X": "X", "Y": "Z", "Z": "Y"}[name[0]] + name[1:] for name in rotations]
        channels.append((*names[: len(names) - len(rotations)], *renamed))
    moved.channels, moved.values = channels, values
    clip = retarget(read_bvh(write(tmp_path, moved.text())), replace(chosen, up="z"), REST)
    np.testing.assert_allclose(clip.trans, expected.trans, atol=1e-9)
    turned = Rotation.from_rotvec(clip.poses.reshape(-1, 3)).inv() * Rotation.from_rotvec(
        expected.poses.reshape(-1, 3)
    )
    assert turned.magnitude().max() < 1e-7


def test_translation_is_scaled_by_the_legs(tmp_path: Path) -> None:
    sample = person("cmu_daz", 3, 0)
    sample.values[:] = 0
    sample.values[2, :3] = [100, 20, -50]
    bvh = read_bvh(write(tmp_path, sample.text()))
    legs = [np.linalg.norm(REST[child] - REST[joint]) for joint, child in ((1, 4), (4, 7))]
    source = np.linalg.norm([0, -36.8, 0.7]) + np.linalg.norm([-0.7, -45.1, -5.1])
    moved = np.diff(retarget(bvh, load_skeleton("cmu_daz"), REST).trans, axis=0)[0]
    np.testing.assert_allclose(moved, np.array([100, 50, 20]) * sum(legs) / source, atol=1e-9)


def test_hip_joints_lie_where_the_scaled_source_has_them(tmp_path: Path) -> None:
    """So legs of the same direction end where the source's do, though DAZ' hip is below the hip joints."""
    bvh, chosen = read(tmp_path, "cmu_daz"), load_skeleton("cmu_daz")
    hips = [bvh.nodes.index("lThigh"), bvh.nodes.index("rThigh")]
    source = to_z_up(bvh.kinematics()[1][1:, hips].mean(1)) * 0.01 * fit(bvh, chosen, REST).scale
    body = on_body(retarget(bvh, chosen, REST))[1][:, [1, 2]].mean(1)
    np.testing.assert_allclose(body, source, atol=1e-9)


def test_calibration_frame_is_dropped(tmp_path: Path) -> None:
    bvh, chosen = read(tmp_path, "cmu_daz", frames=6), load_skeleton("cmu_daz")
    dropped, kept = retarget(bvh, chosen, REST), retarget(bvh, replace(chosen, calibration_frame=False), REST)
    assert (len(dropped), len(kept)) == (5, 6)
    np.testing.assert_array_equal(dropped.poses, kept.poses[1:])
    np.testing.assert_array_equal(dropped.trans, kept.trans[1:])
    with refuse(tmp_path / "clip.bvh", "only the calibration frame"):
        retarget(read(tmp_path, "cmu_daz", frames=1), chosen, REST)


# Skeleton maps


def test_shipped_maps() -> None:
    assert shipped_skeletons() == ("cmu_daz", "cmu_motionbuilder")
    for name in shipped_skeletons():
        assert load_skeleton(name).name == name


@pytest.mark.parametrize("skeleton", TREES)
def test_units_give_people(tmp_path: Path, skeleton: str) -> None:
    own = fit(read(tmp_path, skeleton), load_skeleton(skeleton), REST).own_rest
    assert 0.75 < sum(np.linalg.norm(own[child] - own[joint]) for joint, child in ((1, 4), (4, 7))) < 0.9


@pytest.mark.parametrize("skeleton", TREES)
def test_the_joints_choose_the_map(tmp_path: Path, skeleton: str) -> None:
    bvh = read(tmp_path, skeleton)
    assert find_skeleton(bvh).name == skeleton
    assert [set(load_skeleton(name).joints.values()) <= set(bvh.nodes) for name in TREES].count(True) == 1


def test_unknown_skeleton_lists_joints_and_maps(tmp_path: Path) -> None:
    path = write(tmp_path, person("cmu_daz", 2, 0).text().replace("lShin", "shinbone"))
    with refuse(path, "shinbone", "rThigh", "cmu_daz, cmu_motionbuilder"):
        find_skeleton(read_bvh(path))


def test_a_file_of_two_skeletons_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("one", "two"):
        (tmp_path / f"{name}.yaml").write_text((SKELETONS / "cmu_daz.yaml").read_text())
    monkeypatch.setattr("memmlp.data.skeleton.SKELETONS", tmp_path)
    with refuse(tmp_path, "more than one"):
        find_skeleton(read(tmp_path, "cmu_daz"))


def test_a_map_of_other_joints_is_refused(tmp_path: Path) -> None:
    bvh, chosen = read(tmp_path, "cmu_daz"), load_skeleton("cmu_daz")
    with refuse(bvh.path, "Hips"):
        fit(bvh, load_skeleton("cmu_motionbuilder"), REST)
    swapped = chosen.joints | {"left_knee": "lFoot", "left_ankle": "lShin"}
    with refuse(bvh.path, "lShin is not below lFoot"):
        fit(bvh, replace(chosen, joints=swapped), REST)


def test_a_zero_pose_that_does_not_stand_is_refused(tmp_path: Path) -> None:
    bvh, chosen = read(tmp_path, "cmu_daz"), load_skeleton("cmu_daz")
    behind = replace(bvh, offsets=bvh.offsets * [-1, 1, -1])
    with refuse(bvh.path, "left_shoulder", "T-pose"):
        fit(behind, chosen, REST)
    with refuse(bvh.path, "0 m"):
        fit(replace(bvh, offsets=bvh.offsets * 0), chosen, REST)


def test_a_unit_out_of_this_world_is_refused(tmp_path: Path) -> None:
    bvh = read(tmp_path, "cmu_daz")
    with refuse(bvh.path, "10000 m"):
        retarget(replace(bvh, values=bvh.values * 1e4), load_skeleton("cmu_daz"), REST)


def user_map(folder: Path, **changes: object) -> Path:
    content = yaml.safe_load((SKELETONS / "cmu_daz.yaml").read_text()) | {"name": "mine"} | changes
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in content.items() if value is not None}))
    return path


def test_a_users_map(tmp_path: Path) -> None:
    path = user_map(tmp_path, unit=0.02, calibration_frame=False, rates=None)
    assert load_skeleton(str(path)).unit == 0.02
    report = import_folder(
        write(tmp_path, person("cmu_daz", 4, 0).text()), tmp_path / "out", skeleton=str(path)
    )
    assert [(clip.skeleton, clip.frames) for clip in report.clips] == [("mine", 4)]


JOINTS_OF_DAZ = load_skeleton("cmu_daz").joints


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"unit": "cm"}, "unit"),
        ({"unit": 0}, "unit"),
        ({"unit": float("nan")}, "unit"),
        ({"unit": True}, "unit"),
        ({"unit": None}, "keys"),
        ({"up": "x"}, "y or z"),
        ({"calibration_frame": 1}, "true or false"),
        ({"rates": {"salsa": 0}}, "rates.salsa"),
        ({"rates": {4: 60}}, "rates.4"),
        ({"rates": [60]}, "rates"),
        ({"name": 3}, "name"),
        ({"colour": "red"}, "keys"),
        ({"joints": "all"}, "joints"),
        ({"joints": {}}, "joints.pelvis"),
        ({"joints": JOINTS_OF_DAZ | {"tail": "hip"}}, "joints.tail"),
        ({"joints": JOINTS_OF_DAZ | {"head": True}}, "joints.head"),
        ({"joints": JOINTS_OF_DAZ | {"head": "neck"}}, "neck"),
    ],
)
def test_wrong_maps_are_refused(tmp_path: Path, changes: dict[str, object], said: str) -> None:
    path = user_map(tmp_path, **changes)
    with refuse(path, said):
        load_skeleton(str(path))


@pytest.mark.parametrize(
    "text", ["", "[", "a: 1\na: 2", "!!python/name:os.system", "[" * 1500, "\0", "- 1", "{{}: 1}"]
)
def test_maps_that_are_none_are_refused(tmp_path: Path, text: str) -> None:
    path = write(tmp_path, text, "mine.yaml")
    with pytest.raises(InputError, match=r"\A[^\n]*mine\.yaml[^\n]*\Z"):
        load_skeleton(str(path))


def test_a_key_that_stands_twice_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, user_map(tmp_path).read_text() + "\nunit: 0.02\n", "mine.yaml")
    with refuse(path, "'unit' stands twice"):
        load_skeleton(str(path))


def test_a_map_that_is_missing_is_refused(tmp_path: Path) -> None:
    with refuse("skeleton: ", "cmu_daz, cmu_motionbuilder"):
        load_skeleton(str(tmp_path / "none.yaml"))


# Damaged files


def test_damaged_files_are_refused_in_one_line(tmp_path: Path) -> None:
    """200 pieces of damage: each gives a finite clip or one line that names the file."""
    data, refused = person("cmu_daz", 4, 7).text().encode(), []
    for seed in range(200):
        path = write(tmp_path, mutate(data, seed), f"damaged {seed}.bvh")
        try:
            bvh = read_bvh(path)
            clip = retarget(bvh, find_skeleton(bvh), REST)
        except InputError as error:
            refused.append((path, str(error)))
        else:
            assert len(clip) > 0
            assert np.isfinite(clip.poses).all()
            assert np.isfinite(clip.trans).all()
    for path, message in refused:
        assert message.startswith(str(path))
        assert len(message.splitlines()) == 1
    assert 150 <= len(refused) < 200


# Folders


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """salsa/01, salsa/02, indian/01 and top.bvh, each of 3 frames at 120 Hz by the header."""
    for seed, name in enumerate(["salsa/01", "salsa/02", "indian/01", "top"]):
        write(tmp_path / "source", person("cmu_daz", 3, seed).text("\r\n"), f"{name}.bvh")
    write(tmp_path / "source", "no motion", "readme.txt")
    return tmp_path / "source"


def rates(out: Path) -> dict[str, float]:
    files = sorted(out.rglob("*.npz"))
    return {name: read_clip(path, name).fps for path in files for name in [path.relative_to(out).as_posix()]}


def test_import_writes_clips_and_record(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    report = import_folder(source, out)
    assert rates(out) == {"indian/01.npz": 120, "salsa/01.npz": 60, "salsa/02.npz": 60, "top.npz": 120}
    assert [clip.source for clip in report.clips] == [
        "indian/01.bvh",
        "salsa/01.bvh",
        "salsa/02.bvh",
        "top.bvh",
    ]
    assert report.notes == ("salsa: 60 Hz, known of salsa in cmu_daz; the header says 120 Hz",)
    record = json.loads((out / "import.json").read_text())
    assert [clip["clip"] for clip in record["clips"]] == sorted(rates(out))
    assert record["clips"][3]["sha256"] == hashlib.sha256((source / "top.bvh").read_bytes()).hexdigest()
    assert str(tmp_path) not in (out / "import.json").read_text()
    assert not [path for path in tmp_path.iterdir() if path.name not in ("source", "out")]
    bvh = read_bvh(source / "salsa/02.bvh")
    expected = retarget(bvh, find_skeleton(bvh), REST)
    clip = read_clip(out / "salsa/02.npz", "salsa/02")
    np.testing.assert_array_equal(clip.poses.astype(np.float32), expected.poses.astype(np.float32))


def test_import_twice_is_the_same(source: Path, tmp_path: Path) -> None:
    first = import_folder(source, tmp_path / "out")
    record = (tmp_path / "out" / "import.json").read_bytes()
    assert import_folder(source, tmp_path / "out") == first
    assert (tmp_path / "out" / "import.json").read_bytes() == record


@pytest.mark.parametrize(
    ("fps", "expected"),
    [
        ({"salsa": 100}, [120, 100, 100, 120]),
        ({"": 50}, [50, 50, 50, 50]),
        ({"": 50, "salsa": 120}, [50, 120, 120, 50]),
        ({"indian": 30.5}, [30.5, 60, 60, 120]),
    ],
)
def test_given_rates(source: Path, tmp_path: Path, fps: dict[str, float], expected: list[float]) -> None:
    report = import_folder(source, tmp_path / "out", fps=fps)
    assert list(rates(tmp_path / "out").values()) == expected
    assert [clip.fps for clip in report.clips] == expected
    assert all("given" in clip.fps_reason for clip in report.clips if clip.fps not in (60, 120))
    corrected = {Path(clip.source).parent.as_posix() for clip in report.clips if clip.fps != 120}
    assert {note.split(":")[0] for note in report.notes} == corrected


@pytest.mark.parametrize(
    "fps", [{"waltz": 60}, {"salsa": 0}, {"salsa": float("nan")}, {"": 5000}, {"salsa/": 60}]
)
def test_wrong_rates_are_refused(source: Path, tmp_path: Path, fps: dict[str, float]) -> None:
    with refuse("fps: ", "'indian', 'salsa'"):
        import_folder(source, tmp_path / "out", fps=fps)


def test_known_rate_holds_for_the_folder_or_file_itself(source: Path, tmp_path: Path) -> None:
    assert import_folder(source / "salsa", tmp_path / "a").clips[0].fps == 60
    assert import_folder(source / "salsa" / "01.bvh", tmp_path / "b").clips[0].fps == 60
    assert (tmp_path / "b" / "01.npz").is_file()


def test_a_header_that_is_right_is_not_corrected(source: Path, tmp_path: Path) -> None:
    write(source, person("cmu_daz", 3, 0).text(dt="0.0166667"), "salsa/01.bvh")
    report = import_folder(source / "salsa/01.bvh", tmp_path / "out")
    assert (report.clips[0].fps, report.clips[0].fps_reason) == (60, "the header's")
    assert report.notes == ()


def test_bad_files_are_skipped(source: Path, tmp_path: Path) -> None:
    import_folder(source, tmp_path / "out")
    write(source, "HIERARCHY", "salsa/01.bvh")
    report = import_folder(source, tmp_path / "out")
    assert [skipped.source for skipped in report.skipped] == ["salsa/01.bvh"]
    assert report.skipped[0].reason.startswith("salsa/01.bvh: no MOTION")
    assert list(rates(tmp_path / "out")) == ["indian/01.npz", "salsa/02.npz", "top.npz"]
    assert str(tmp_path) not in (tmp_path / "out" / "import.json").read_text()


def test_strict_import_leaves_nothing(source: Path, tmp_path: Path) -> None:
    write(source, "HIERARCHY", "salsa/01.bvh")
    with refuse(source / "salsa/01.bvh", "no MOTION"):
        import_folder(source, tmp_path / "out", strict=True)
    assert [path.name for path in tmp_path.iterdir()] == ["source"]


def test_strict_import_leaves_an_earlier_one_alone(source: Path, tmp_path: Path) -> None:
    import_folder(source, tmp_path / "out")
    before = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*.*")}
    write(source, person("cmu_daz", 9, 9).text(), "indian/01.bvh")
    write(source, "HIERARCHY", "top.bvh")
    with pytest.raises(InputError):
        import_folder(source, tmp_path / "out", strict=True)
    assert {path: path.read_bytes() for path in (tmp_path / "out").rglob("*.*")} == before


def test_nothing_to_import_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for source in (tmp_path / "empty", tmp_path / "missing", write(tmp_path, "", "clip.txt")):
        with refuse(source):
            import_folder(source, tmp_path / "out")
        with refuse(source):
            verify_folder(source)
    for name in ("a", "b"):
        write(tmp_path / "bad", "HIERARCHY", f"{name}.bvh")
    with pytest.raises(InputError, match=r"no usable BVH file of 2; the first: a\.bvh"):
        import_folder(tmp_path / "bad", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_two_files_of_one_clip_are_refused(source: Path, tmp_path: Path) -> None:
    write(source, person("cmu_daz", 3, 0).text(), "salsa/01.BVH")
    if len(list((source / "salsa").iterdir())) == 2:
        pytest.skip("the file system does not tell 01.bvh from 01.BVH")
    with refuse("salsa/01", "2 BVH files"):
        import_folder(source, tmp_path / "out")


def test_foreign_clips_in_out_are_refused(source: Path, tmp_path: Path) -> None:
    write(tmp_path / "out", "", "walk/01.npz")
    with refuse(tmp_path / "out", "walk/01.npz"):
        import_folder(source, tmp_path / "out")
    with refuse(source / "top.bvh", "is a file"):
        import_folder(source, source / "top.bvh")


def test_verify_folder_names_files(source: Path) -> None:
    found = verify_folder(source, skeleton="cmu_daz")
    assert [fidelity.name for fidelity in found] == [
        "indian/01.bvh",
        "salsa/01.bvh",
        "salsa/02.bvh",
        "top.bvh",
    ]
    assert max(fidelity.worst_mm for fidelity in found) < 0.01
    write(source, "HIERARCHY", "salsa/01.bvh")
    with refuse(source / "salsa/01.bvh", "no MOTION"):
        verify_folder(source)


# The database's own files


@pytest.mark.skipif(
    not CMU.is_dir(), reason="the CMU clips are not beside the repository (../shared/data/cmu)"
)
@pytest.mark.parametrize("name", CLIPS)
def test_cmu_clips(name: str) -> None:
    path = CMU / f"{name}.bvh"
    fidelity = verify(path)
    assert fidelity.worst_mm < 1
    assert fidelity.worst_degrees < 3
    bvh = read_bvh(path)
    assert (len(bvh.names), bvh.fps, fidelity.frames) == (43, 120, len(bvh) - 1)


@pytest.mark.skipif(
    not CMU.is_dir(), reason="the CMU clips are not beside the repository (../shared/data/cmu)"
)
def test_cmu_dancers_dance_upright_on_the_floor() -> None:
    bvh = read_bvh(CMU / "salsa" / "10.bvh")
    clip = retarget(bvh, find_skeleton(bvh), REST)
    positions = on_body(clip)[1]
    height = np.median(positions[..., 2], axis=0)
    assert 1.4 < height[JOINT["head"]] < 1.65
    assert 0.85 < height[JOINT["pelvis"]] < 1.0
    assert abs(np.percentile(positions[:, [JOINT["left_foot"], JOINT["right_foot"]], 2].min(1), 5)) < 0.05
