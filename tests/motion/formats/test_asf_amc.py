"""ASF/AMC files: kinematics against plain NumPy, the databases' quirks, and damaged files."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from memmlp.common.errors import InputError
from memmlp.motion.body import JOINTS, make_builtin_rest_joints
from memmlp.motion.formats.asf_amc import read_amc
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.geometry import compute_clip_kinematics
from memmlp.motion.importing.fidelity import Fidelity
from memmlp.motion.importing.import_folder import import_folder, verify_folder

# Bone, parent, direction and length in the zero pose, angles of its own axes, values in a frame.
SKELETON = """
lhipjoint root 0.66 -0.67 0.34 2.4 0 0 0
lfemur lhipjoint 0.34202 -0.939693 0 7.1 0 0 20 rx ry rz
ltibia lfemur 0.34202 -0.939693 0 7.4 0 0 20 rx
lfoot ltibia 0.1 -0.27 0.957 2.2 -90 0 20 rx rz
ltoes lfoot 0 0 1 1.1 -90 0 20 rx
rhipjoint root -0.66 -0.67 0.34 2.4 0 0 0
rfemur rhipjoint -0.34202 -0.939693 0 7.1 0 0 -20 rx ry rz
rtibia rfemur -0.34202 -0.939693 0 7.4 0 0 -20 rx
rfoot rtibia -0.1 -0.27 0.957 2.2 -90 0 -20 rx rz
rtoes rfoot 0 0 1 1.1 -90 0 -20 rx
lowerback root 0 1 -0.05 2.1 0 0 0 rx ry rz
upperback lowerback 0 1 -0.02 2.1 0 0 0 rx ry rz
thorax upperback 0 1 0 2.1 0 0 0 rx ry rz
lowerneck thorax 0 1 0 1.7 0 0 0 rx ry rz
upperneck lowerneck 0 0.93 -0.37 1.6 0 0 0 rx ry rz
head upperneck 0 0.99 -0.1 1.7 0 0 0 rx ry rz
lclavicle thorax 0.98 0.15 0.05 3.5 0 0 0 ry rz
lhumerus lclavicle 1 0 0 5.4 180 -30 -90 rx ry rz
lradius lhumerus 1 0 0 2.6 180 -30 -90 rx
lwrist lradius 1 0 0 1.3 -90 90 0 ry
lhand lwrist 1 0 0 0.7 -90 90 0 rx rz
lfingers lhand 1 0 0 0.6 -90 90 0 rx
lthumb lwrist 0.7 0 0.7 0.8 -90 45 0 rx rz
rclavicle thorax -0.98 0.15 0.05 3.5 0 0 0 ry rz
rhumerus rclavicle -1 0 0 5.4 180 30 90 rx ry rz
rradius rhumerus -1 0 0 2.6 180 30 90 rx
rwrist rradius -1 0 0 1.3 -90 -90 0 ry
rhand rwrist -1 0 0 0.7 -90 -90 0 rx rz
rfingers rhand -1 0 0 0.6 -90 -90 0 rx
rthumb rwrist -0.7 0 0.7 0.8 -90 -45 0 rx rz
"""
BONES = {name: rest for name, *rest in map(str.split, SKELETON.strip().splitlines())}
ANGLES = ("rx", "ry", "rz")
DOFS = {"root": ["tx", "ty", "tz", *ANGLES], **{name: rest[8:] for name, rest in BONES.items() if rest[8:]}}


def asf_text() -> str:
    """The skeleton's file, with comments, bytes of Latin-1 and limits as the databases have them."""
    lines = ["# made f\xfcr tests", ":version 1.10", ":name VICON", ":units", "  mass 1.0", "  length 0.45"]
    lines += ["  angle deg", ":documentation", "   a person", ":root", "   order TX TY TZ RX RY RZ"]
    lines += ["   axis XYZ", "   position 0 0 0  ", "   orientation 0 0 0 ", ":bonedata"]
    children: dict[str, list[str]] = {}
    for number, (name, (parent, x, y, z, length, *angles)) in enumerate(BONES.items(), start=1):
        children.setdefault(parent, []).append(name)
        lines += ["  begin", f"     id {number}", f"     name {name}", f"     direction {x} {y} {z}"]
        lines += [f"     length {length}", f"     axis {' '.join(angles[:3])}  XYZ"]
        if dofs := angles[3:]:
            limits = ["    limits (-160.0 20.0)", *["           (-70.0 70.0)"] * (len(dofs) - 1)]
            lines += [f"    dof {' '.join(dofs)}", *limits]
        lines.append("  end")
    lines += [":hierarchy", "  begin", *(f"    {p} {' '.join(c)}" for p, c in children.items()), "  end"]
    return "\n".join(lines) + "\n"


def amc_text(values: np.ndarray, first: int = 1) -> str:
    """A take with these values (N, 62), in the order of `DOFS`."""
    lines = ["#!OML:ASF X:\\f\xfcr tests\\person.ASF", ":FULLY-SPECIFIED", ":DEGREES"]
    for number, row in enumerate(values.tolist(), start=first):
        lines.append(str(number))
        for name, dofs in DOFS.items():
            own, row = row[: len(dofs)], row[len(dofs) :]
            lines.append(" ".join([name, *(f"{value:.6g}" for value in own)]))
    return "\n".join(lines) + "\n"


COLUMNS = [(name, dof) for name, dofs in DOFS.items() for dof in dofs]
"""Of values (N, 62)."""


def movement(frames: int, size: float = 20.0) -> np.ndarray:
    """Values (N, 62) of a person who stands, with all joints swinging: knees and elbows bend one way."""
    random = np.random.default_rng(1)
    phase, speed = random.uniform(0, 6, len(COLUMNS)), random.uniform(1, 3, len(COLUMNS))
    values = size * np.sin(phase + np.outer(np.arange(frames) / 20, speed))
    values[:, [name in ("ltibia", "rtibia", "lradius", "rradius") for name, _ in COLUMNS]] += size
    values[:, :3] = [0.3, 17.0, 0.8] + 0.02 * values[:, :3]
    return values


def write_take(folder: Path, values: np.ndarray, first: int = 1) -> Path:
    """Write SUBJECT.asf and SUBJECT_01.amc, where SUBJECT is the folder's name; return the take."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{folder.name}.asf").write_text(asf_text(), encoding="latin-1")
    take = folder / f"{folder.name}_01.amc"
    take.write_text(amc_text(values, first), encoding="latin-1")
    return take


def plain_positions(values: np.ndarray) -> dict[str, np.ndarray]:
    """The positions (N, 3), metres, of each bone's start, `BONE.end` being its end; by SciPy."""

    def turn(angles: np.ndarray) -> np.ndarray:
        return Rotation.from_euler("xyz", angles, degrees=True).as_matrix()

    scale = 2.54 / 0.45 / 100
    starts, rotations = {"root": scale * values[:, :3]}, {"root": turn(values[:, 3:6])}
    ends = {"root": starts["root"]}
    for name, (parent, *numbers) in BONES.items():
        direction, length, axis = np.split(np.array(numbers[:7], float), [3, 4])
        angles = np.zeros((len(values), 3))
        for column, (bone, dof) in enumerate(COLUMNS):
            if bone == name:
                angles[:, ANGLES.index(dof)] = values[:, column]
        rotations[name] = rotations[parent] @ turn(axis) @ turn(angles) @ turn(axis).T
        starts[name], ends[name] = ends[parent], ends[parent] + rotations[name] @ (scale * length * direction)
    return starts | {f"{name}.end": end for name, end in ends.items()}


CUTS = {
    "32_01": 120, "32_02": 120, "35_02": 20, "35_05": 10, "35_09": 10, "35_10": 10, "35_11": 16, "35_12": 20,
    "35_13": 80, "35_30": 160, "38_02": 50, "39_08": 30, "39_12": 30, "55_04": 150,
}  # fmt: skip
"""Takes that were cut at the start -> the number of their first frame, by the data's README."""


def assert_imported(source: Path, out: Path) -> None:
    """The clips of a folder have every segment and joint within the limits of an import."""
    report = import_folder(source, out)
    assert not report.skipped
    assert {(clip.fps, clip.header_fps) for clip in report.clips} == {(120, None)}
    for fidelity in verify_folder(source):
        assert isinstance(fidelity, Fidelity)
        assert (fidelity.mm.value < 1, fidelity.degrees.value < 3) == (True, True), fidelity


def test_an_import_has_the_files_segments(tmp_path: Path):
    write_take(tmp_path / "in" / "05", movement(60))
    write_take(tmp_path / "in" / "HDM_bd", movement(40, size=10.0), first=7)
    assert_imported(tmp_path / "in", tmp_path / "out")


def test_head_and_soles_of_a_person_who_stands_are_level(tmp_path: Path):
    """In the zero pose the head leans back, and the legs are spread by 20 degrees together with the feet."""
    values = np.zeros((2, 62))
    values[:, 1] = 17.0
    for bone, dof, degrees in (("head", "rx", 16.0), ("lfemur", "rz", -20.0), ("rfemur", "rz", 20.0)):
        values[:, COLUMNS.index((bone, dof))] = degrees
    write_take(tmp_path / "05", values)
    import_folder(tmp_path / "05", tmp_path / "out")
    clip = read_clip(tmp_path / "out" / "05_01.npz", "05_01")
    rotations, _ = compute_clip_kinematics(clip, make_builtin_rest_joints())
    assert np.degrees(np.arcsin(rotations[0, 15, 2, 2])) == pytest.approx(0, abs=0.1)
    assert np.degrees(np.arcsin(rotations[0, [7, 8], 2, 0])) == pytest.approx([0, 0], abs=2.0)


def test_joints_are_where_plain_kinematics_puts_them(tmp_path: Path):
    values = movement(12, size=60.0).round(3)  # as far as a take has digits
    recording, expected = read_amc(write_take(tmp_path / "05", values)), plain_positions(values)
    zero, positions = plain_positions(0 * values[:1]), recording.compute_kinematics()[1]
    assert recording.fps is None
    for node, name in enumerate(recording.nodes):
        np.testing.assert_allclose(positions[:, node], expected[name], atol=1e-6)
        np.testing.assert_allclose(recording.compute_zero_pose()[node], zero[name][0], atol=1e-9)


def test_cut_starts_line_ends_and_the_order_of_bones_do_not_matter(tmp_path: Path):
    values = movement(3)
    plain = read_amc(write_take(tmp_path / "05", values))
    take = write_take(tmp_path / "05", values, first=120)
    lines = take.read_text("latin-1").splitlines()
    lines[4:6] = lines[5:3:-1]  # within the first frame
    take.write_bytes("\r\n".join([*lines, "", ""]).encode("latin-1"))
    cut = read_amc(take)
    assert (plain.first_frame, cut.first_frame) == (1, 120)
    assert np.array_equal(plain.values, cut.values)


def test_the_skeleton_is_that_of_the_same_name(tmp_path: Path):
    first = write_take(tmp_path / "HDM_bd", movement(1))
    (tmp_path / "HDM_bd" / "HDM.asf").write_text("another")
    take = first.rename(first.with_name("HDM_bd_kickRFront1Reps_001_120.AMC"))
    assert len(read_amc(take)) == 1
    (tmp_path / "HDM_bd" / "HDM_bd.asf").rename(tmp_path / "bd.asf")
    (tmp_path / "HDM_bd" / "HDM.asf").unlink()
    with pytest.raises(InputError, match=r"_120\.AMC: no skeleton in the same folder; expected HDM\.asf"):
        read_amc(take)


@pytest.mark.parametrize(("old", "new", "said"), [
    ("angle deg", "angle rad", "line 7: angle rad; expected angle deg"),
    (":bonedata", ":bones", "no :bonedata"),
    ("direction 0 0 1", "direction 0 zero 1", "direction 0 zero 1; expected 3 numbers"),
    ("dof rx ry rz", "dof rx ry l", "rx ry l; expected one or more of rx ry rz"),
    ("    ltibia lfoot\n", "", "lfoot; expected root, or a bone that is a child in an earlier line"),
    ("position 0 0 0", "position 0 1 0", "position 0 1 0; expected 0 0 0"),
    ("  end\n:hierarchy", ":hierarchy", "the last bone of :bonedata has no end"),
])  # fmt: skip
def test_damaged_skeletons_are_one_line(tmp_path: Path, old: str, new: str, said: str):
    take, asf = write_take(tmp_path / "05", movement(1)), tmp_path / "05" / "05.asf"
    assert old in asf_text()
    asf.write_text(asf_text().replace(old, new, 1), encoding="latin-1")
    with pytest.raises(InputError, match=rf"^{asf}: .*{re.escape(said)}.*\Z"):
        read_amc(take)


@pytest.mark.parametrize(("old", "new", "said"), [
    (r"\nltoes .*", "", "frame 1 without ltoes"),
    (r"\n2\n", "\n3\n", "frame 3 after frame 1; expected frame 2"),
    (r"\nlowerback \S+", "\nlowerback x", "lowerback x"),
    (r"\nlradius ", "\nlelbow ", "lelbow; expected a bone with angles, at most once per frame"),
    (r"(?s)\n1\n.*", "\n", "no frames"),
    (r":DEGREES", ":RADIANS", "line 3: :RADIANS; expected frames in degrees"),
])  # fmt: skip
def test_damaged_takes_are_one_line(tmp_path: Path, old: str, new: str, said: str):
    take = write_take(tmp_path / "05", movement(2))
    text, changes = re.subn(old, new, amc_text(movement(2)), count=1)
    assert changes == 1
    take.write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match=rf"^{take}: .*{re.escape(said)}.*\Z"):
        read_amc(take)


@pytest.mark.long
@pytest.mark.parametrize(("name", "takes", "cuts"), [("cmu-asfamc", 142, CUTS), ("hdm05-asfamc", 233, {})])
def test_the_databases_have_the_takes_and_cuts_of_their_readmes(
    database: Callable[[str], Path], tmp_path: Path, name: str, takes: int, cuts: dict[str, int]
):
    paths = sorted(database(name).rglob("*.amc"), key=lambda take: take.stat().st_size)
    starts = {take.stem: first_frame(take) for take in paths}
    assert (len(starts), {take: first for take, first in starts.items() if first != 1}) == (takes, cuts)
    assert read_amc(paths[0]).first_frame == starts[paths[0].stem]
    for file in (paths[0], *paths[0].parent.glob("*.asf")):
        (tmp_path / "in").mkdir(exist_ok=True)
        (tmp_path / "in" / file.name).symlink_to(file)
    assert_imported(tmp_path / "in", tmp_path / "out")


@pytest.mark.slow
def test_two_forms_of_a_take_are_one_body(database: Callable[[str], Path], tmp_path: Path):
    """ASF/AMC and the MotionBuilder conversion, which has no length between thorax and neck."""
    takes = (
        database("cmu-motionbuilder") / "cmu-motionbuilder/05/05_06.bvh",
        database("cmu-asfamc") / "cmu-asfamc/05/05_06.amc",
    )
    clips = []
    for take in takes:
        import_folder(take, tmp_path / take.suffix)
        clips.append(read_clip(tmp_path / take.suffix / "05_06.npz", "clip"))
    one, other = (compute_clip_kinematics(clip, make_builtin_rest_joints())[0] for clip in clips)
    turns = Rotation.from_matrix((one.swapaxes(-1, -2) @ other).reshape(-1, 3, 3))
    angles = np.degrees(turns.magnitude()).reshape(len(one), -1)
    assert np.delete(angles, JOINTS.index("spine3"), 1).max() < 3


def first_frame(take: Path) -> int:
    """The number in the first line of a number alone."""
    with take.open(encoding="latin-1") as lines:
        return next(int(line) for line in lines if line.strip().isdigit())
