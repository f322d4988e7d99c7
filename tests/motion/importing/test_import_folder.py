"""Folders of BVH files to folders of clips: rates, floors, notes, and what is refused."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from bvh_samples import performed, person, refuse, tree, write

from memmlp.common.errors import InputError
from memmlp.motion.body import JOINTS, make_builtin_rest_joints
from memmlp.motion.clip import Clip, SkippedFile
from memmlp.motion.formats.bvh import read_bvh
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.geometry import compute_clip_kinematics
from memmlp.motion.importing.convert import NONE, convert_recording
from memmlp.motion.importing.import_folder import ImportSettings, import_folder, verify_folder
from memmlp.motion.importing.skeleton_map import find_skeleton, load_skeleton
from memmlp.motion.synthetic import synthesize_clip

REST = make_builtin_rest_joints()


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """salsa/01, salsa/02, indian/01 and top.bvh, 3 frames at 120 Hz by the header."""
    for seed, name in enumerate(["salsa/01", "salsa/02", "indian/01", "top"]):
        write(tmp_path / "source", person("cmu_daz", 3, seed).text("\r\n"), f"{name}.bvh")
    write(tmp_path / "source", "no motion", "readme.txt")
    return tmp_path / "source"


def rates(out: Path) -> dict[str, float]:
    files = sorted(out.rglob("*.npz"))
    return {name: read_clip(path, name).fps for path in files for name in [path.relative_to(out).as_posix()]}


def test_import_writes_clips_and_record(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    report = import_folder(source, out, ImportSettings(floor=NONE, fps={"salsa": 60.0}))
    assert rates(out) == {"indian/01.npz": 120, "salsa/01.npz": 60, "salsa/02.npz": 60, "top.npz": 120}
    assert [clip.source for clip in report.clips] == [f"{name[:-4]}.bvh" for name in rates(out)]
    assert report.notes == ("salsa: 60 Hz, set for salsa; the header has 120 Hz (01.bvh, 02.bvh)",)
    record = json.loads((out / "import.json").read_text())
    assert [clip["clip"] for clip in record["clips"]] == sorted(rates(out))
    assert record["clips"][3]["sha256"] == hashlib.sha256((source / "top.bvh").read_bytes()).hexdigest()
    assert str(tmp_path) not in (out / "import.json").read_text()
    assert not [path for path in tmp_path.iterdir() if path.name not in ("source", "out")]
    bvh = read_bvh(source / "salsa/02.bvh")
    expected = convert_recording(bvh, find_skeleton(bvh), REST, name="clip", fps=60.0).clip
    clip = read_clip(out / "salsa/02.npz", "salsa/02")
    np.testing.assert_array_equal(clip.poses.astype(np.float32), expected.poses.astype(np.float32))


def test_given_rates(source: Path, tmp_path: Path) -> None:
    given = ImportSettings(fps={"": 50, "salsa": 30.5}, floor=NONE)
    report = import_folder(source, tmp_path / "out", given)
    assert list(rates(tmp_path / "out").values()) == [50, 30.5, 30.5, 50]
    assert [clip.fps for clip in report.clips] == [50, 30.5, 30.5, 50]
    assert {note.split(":")[0] for note in report.notes} == {".", "indian", "salsa"}
    for fps, words in (
        ({"waltz": 60}, ["--fps waltz=60", "indian, salsa"]),
        ({"salsa": 0}, ["--fps salsa=0", "1 to 1000 Hz"]),
        ({"": float("nan")}, ["--fps nan", "1 to 1000 Hz"]),
    ):
        with refuse(*words):
            import_folder(source, tmp_path / "wrong", ImportSettings(fps=fps, floor=NONE))


def test_bad_files_are_skipped(source: Path, tmp_path: Path) -> None:
    import_folder(source, tmp_path / "out")
    write(source, "HIERARCHY", "salsa/01.bvh")
    report = import_folder(source, tmp_path / "out")
    assert [skipped.file for skipped in report.skipped] == ["salsa/01.bvh"]
    assert report.skipped[0].reason.startswith("has no MOTION")
    assert list(rates(tmp_path / "out")) == ["indian/01.npz", "salsa/02.npz", "top.npz"]
    assert str(tmp_path) not in (tmp_path / "out" / "import.json").read_text()


def test_a_strict_or_failed_import_leaves_no_record_of_other_clips(source: Path, tmp_path: Path, monkeypatch):
    import_folder(source, tmp_path / "out")
    before = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*.*")}
    write(source, person("cmu_daz", 9, 9).text(), "indian/01.bvh")
    write(source, "HIERARCHY", "top.bvh")
    with pytest.raises(InputError):
        import_folder(source, tmp_path / "out", ImportSettings(strict=True))
    assert {path: path.read_bytes() for path in (tmp_path / "out").rglob("*.*")} == before
    out = tmp_path / "out"
    import_folder(source, out)
    monkeypatch.setattr("shutil.move", mock.Mock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(InputError, match="No space left"):
        import_folder(source, out)
    assert not (out / "import.json").exists()


def test_nothing_to_import_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for source in (tmp_path / "empty", tmp_path / "missing", write(tmp_path, "", "clip.txt")):
        for action in (lambda: import_folder(source, tmp_path / "out"), lambda: list(verify_folder(source))):  # noqa: B023
            with refuse(source):
                action()
    for settings, said in (
        (ImportSettings("none"), "--skeleton none"),
        (ImportSettings(body="none"), "none"),
    ):
        with pytest.raises(InputError, match=said):
            list(verify_folder(write(tmp_path, walk_text()), settings))
    for name in ("a", "b"):
        write(tmp_path / "bad", "HIERARCHY", f"{name}.bvh")
    with pytest.raises(InputError, match=r"no usable file of 2; the first: a\.bvh"):
        import_folder(tmp_path / "bad", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_two_files_of_one_clip_and_foreign_clips_in_out_are_refused(source: Path, tmp_path: Path) -> None:
    write(tmp_path / "out", "", "walk/01.npz")
    with refuse(tmp_path / "out", "walk/01.npz"):
        import_folder(source, tmp_path / "out")
    with refuse(source / "top.bvh", "is a file"):
        import_folder(source, source / "top.bvh")
    write(source, person("cmu_daz", 3, 0).text(), "salsa/01.BVH")
    if len(list((source / "salsa").iterdir())) == 2:
        pytest.skip("the file system does not tell 01.bvh from 01.BVH")
    with refuse("salsa/01", "2 recordings"):
        import_folder(source, tmp_path / "new")


WALK = synthesize_clip("walking", 1, seconds=2.0)
DAZ = load_skeleton("cmu_daz")


def walk_text(clip: Clip = WALK, **options: str) -> str:
    return performed(DAZ, clip, sample=tree("cmu_daz")).text(**options)


@pytest.fixture
def walks(tmp_path: Path) -> Path:
    """Walks on floors of 0.3, 0.5 and 0.9 m."""
    for name, floor in (("a", 0.3), ("b", 0.5), ("c", 0.9)):
        raised = replace(WALK, trans=WALK.trans + np.array([0, 0, floor]))
        write(tmp_path / "source", walk_text(raised, dt="0.0166667"), f"{name}.bvh")
    return tmp_path / "source"


def toes(out: Path) -> list[float]:
    """The lower toe's tenth percentile of each clip, metres."""
    feet = [JOINTS.index("left_foot"), JOINTS.index("right_foot")]
    places = (compute_clip_kinematics(read_clip(path, ""), REST)[1] for path in sorted(out.rglob("*.npz")))
    return [float(np.percentile(joints[:, feet, 2].min(1), 10)) for joints in places]


def test_each_clip_is_put_on_its_floor(walks: Path, tmp_path: Path) -> None:
    write(walks, person("cmu_daz", 9, 9).text(), "flying.bvh")
    report = import_folder(walks, tmp_path / "out")
    assert report.notes == ("flying.bvh: no foot stands still, so the floor height was not corrected",)
    (tmp_path / "out" / "flying.npz").unlink()
    assert max(abs(height - 0.02) for height in toes(tmp_path / "out")) < 0.01
    assert report.clips[-1].floor is None
    found = [float(clip.floor or 0) for clip in report.clips[:-1]]
    assert np.diff(found) == pytest.approx([0.2, 0.4], abs=0.01)


def test_clips_with_faults_are_left_out_where_only_sound_ones_are_wanted(tmp_path: Path) -> None:
    write(tmp_path / "in", performed(DAZ, WALK).text(), "sound.bvh")
    write(tmp_path / "in", performed(DAZ, replace(WALK, trans=3 * WALK.trans)).text(), "sliding.bvh")
    settings = ImportSettings(floor=NONE, sound=True)
    report = import_folder(tmp_path / "in", tmp_path / "out", settings)
    assert [clip.clip for clip in report.clips] == ["sound.npz"]
    assert report.skipped[0].file == "sliding.bvh"
    assert "no joint stands still" in report.skipped[0].reason
    assert not (tmp_path / "out" / "sliding.npz").exists()
    with refuse(tmp_path / "in" / "sliding.bvh", "--sound"):
        import_folder(tmp_path / "in", tmp_path / "strict", replace(settings, strict=True))


def test_verify_measures_files_and_goes_on_past_bad_ones(tmp_path: Path) -> None:
    for name in ("a", "c/1"):
        write(tmp_path, walk_text(), f"{name}.bvh")
    write(tmp_path, "HIERARCHY", "b.bvh")
    first, bad, last = verify_folder(tmp_path, ImportSettings("cmu_daz"))
    assert isinstance(bad, SkippedFile)
    assert (bad.file, bad.reason[:13]) == ("b.bvh", "has no MOTION")
    for fidelity, name in ((first, "a.bvh"), (last, "c/1.bvh")):
        assert (fidelity.name, fidelity.skeleton, fidelity.frames) == (name, "cmu_daz", 120)
        assert fidelity.faults == ()
        assert fidelity.mm.value < 0.01
        assert fidelity.degrees.value < 3
