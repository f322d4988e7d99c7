"""`memmlp data import` and `memmlp data verify` say the same of a bad file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bvh_samples import performed, person, tree, write
from command_line import run

from memmlp.motion.importing.skeleton_map import SKELETONS, load_skeleton
from memmlp.motion.synthetic import synthesize_clip

UNIT = "the legs are 0.32 m long, so the unit may be wrong"


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A sound file, one whose left wrist flies off in frame 31, one that is no BVH, one of nobody we know."""
    chosen = load_skeleton("cmu_daz")
    sample = performed(chosen, synthesize_clip("walking", 1, seconds=1.0), sample=tree("cmu_daz"))
    write(tmp_path / "source", sample.text(), "a.bvh")
    joint = sample.names.index("lHand")
    moved = replace(sample, channels=list(sample.channels), values=sample.values.copy())
    moved.channels[joint] = ("Xposition", "Yposition", "Zposition", *sample.channels[joint])
    column = sum(map(len, sample.channels[:joint]))
    shift = np.tile(sample.offsets[joint], (len(sample.values), 1))
    shift[32] += [4.0, 9.0, 0.0]  # frame 0 is the calibration pose
    moved.values = np.insert(sample.values, [column] * 3, shift, axis=1)
    write(tmp_path / "source", moved.text(), "b.bvh")
    write(tmp_path / "source", "HIERARCHY", "c.bvh")
    write(tmp_path / "source", person("cmu_daz", 3, 0).text().replace("lShin", "shinbone"), "d.bvh")
    return tmp_path / "source"


def test_verify_goes_on_and_names_file_joint_and_frame(source: Path) -> None:
    said = run(source.parent, "data", "verify", "source", code=1)
    lines = said.splitlines()
    changes = "b.bvh: left_elbow to left_wrist changes its length by 5"
    assert [line for line in lines if line.startswith(changes) and "(most in frame 31)" in line]
    assert [line for line in lines if line.startswith("c.bvh: no MOTION")]
    assert [line for line in lines if line.startswith("d.bvh: has an unknown skeleton")]
    assert "1 file without a fault" in said
    assert "3 faults" in said
    assert "Traceback" not in said


def test_verify_of_sound_files_succeeds(source: Path) -> None:
    said = run(source.parent, "data", "verify", "source/a.bvh")
    assert said.startswith("1 file without a fault")
    assert "a.bvh" in run(source.parent, "data", "verify", "source/a.bvh", "--all")
    (source / "a.bvh").rename(source / "[a].bvh")
    assert "[a].bvh" in run(source.parent, "data", "verify", "source/[a].bvh", "--all")


def test_import_warns_with_the_same_sentences(source: Path) -> None:
    verified = run(source.parent, "data", "verify", "source/b.bvh", code=1)
    sentences = [line.removeprefix("b.bvh: ") for line in verified.splitlines() if line.startswith("b.bvh: ")]
    said = run(source.parent, "data", "import", "source", "--out", "out")
    assert f"warning: b.bvh: {'; '.join(sentences)}" in said.splitlines()
    assert "skipped c.bvh: no MOTION" in said
    assert len(list((source.parent / "out").glob("*.npz"))) == 2
    assert "next: memmlp train data=mocap data.root=out" in said.splitlines()
    assert "1 clip, 0.5 seconds, skeleton cmu_daz" in run(
        source.parent, "data", "import", "source/a.bvh", "--out", "one"
    )


def test_a_wrong_unit_is_said_by_both(source: Path) -> None:
    text = (SKELETONS / "cmu_daz.yaml").read_text().replace("unit: 0.01 ", "unit: 0.0039 ")
    path = write(source.parent, text, "mine.yaml")
    for command in (("verify",), ("import", "--out", "out")):
        code = int(command == ("verify",))
        said = run(
            source.parent,
            "data",
            command[0],
            "source/a.bvh",
            *command[1:],
            "--skeleton",
            str(path),
            code=code,
        )
        assert f"a.bvh: {UNIT}" in said


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--fps", "fast"), "--fps fast: no frame rate"),
        (("--fps", "waltz=60"), "fps: 60.0 for 'waltz'"),
        (("--fps", "60", "--fps", "30"), "--fps: all twice"),
        (("--floor", "low"), "--floor low: no height"),
        (("--ground", "nan"), "--floor nan: no height"),
        (("--take", "("), "take: '('"),
        (("--skeleton", "none.yaml"), "skeleton: 'none.yaml' is no file"),
    ],
)
def test_wrong_options_write_nothing(source: Path, options: tuple[str, ...], said: str) -> None:
    told = run(source.parent, "data", "import", "source", "--out", "out", *options, code=2)
    assert said in told
    assert not (source.parent / "out").exists()


def test_an_import_names_the_grouping_of_its_clips(source: Path) -> None:
    (source / "a.bvh").rename(source / "dataset-1_walk_active_001.bvh")
    said = run(source.parent, "data", "import", "source", "--out", "a folder")
    chosen = "data/grouping@data.split=bandai_namco"
    assert f"next: memmlp train data=mocap 'data.root=a folder' {chosen}" in said.splitlines()
