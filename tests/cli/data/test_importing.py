"""`memmlp data import`, `verify` and `skeleton`."""

import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bvh_samples import performed, person, tree, write
from click.testing import CliRunner
from command_line import run
from skeleton_families import walking

from memmlp.cli.data import data
from memmlp.common.errors import InputError
from memmlp.motion.importing.skeleton_map import load_skeleton
from memmlp.motion.synthetic import synthesize_clip


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A sound file, one whose left wrist flies off in frame 31, a damaged one, and an unknown skeleton."""
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
    output = run(source.parent, "data", "verify", "source", code=1)
    for line in (
        r"b\.bvh: left_elbow to left_wrist changes its length by 5.*\(most in frame 31\)",
        r"c\.bvh: has no MOTION", r"d\.bvh: has an unknown skeleton", "1 file without a fault",
    ):  # fmt: skip
        assert re.search(f"^{line}", output, re.M), line
    assert "3 faults" in output
    assert run(source.parent, "data", "verify", "source/a.bvh").startswith("1 file without a fault")
    (source / "a.bvh").rename(source / "[a].bvh")
    assert "[a].bvh" in run(source.parent, "data", "verify", "source/[a].bvh", "--all")


def test_import_warns_of_the_same_faults(source: Path) -> None:
    verified = run(source.parent, "data", "verify", "source/b.bvh", code=1)
    sentences = [line.removeprefix("b.bvh: ") for line in verified.splitlines() if line.startswith("b.bvh: ")]
    (source / "a.bvh").rename(source / "dataset-1_walk_active_001.bvh")
    output = run(source.parent, "data", "import", "source", "--out", "a folder")
    assert f"warning: b.bvh: {'; '.join(sentences)}" in output.splitlines()
    assert "skipped c.bvh: has no MOTION" in output
    assert len(list((source.parent / "a folder").glob("*.npz"))) == 2
    assert "2 clips, 1.0 seconds, skeleton cmu_daz" in output
    next_command = output.partition("next: ")[2].splitlines()[0]
    assert shlex.split(next_command)[:4] == ["memmlp", "train", "data=mocap", "data.root='a folder'"]


@pytest.mark.parametrize(("options", "key"), [
    (("--fps", "fast"), "--fps fast"), (("--fps", "waltz=60"), "a folder waltz"), (("--fps", "0"), "--fps 0"),
    (("--fps", "60", "--fps", "30"), "--fps 30"), (("--floor", "nan"), "--floor nan"),
    (("--skeleton", "none.yaml"), "--skeleton none.yaml"),
])  # fmt: skip
def test_wrong_options_write_nothing(source: Path, options: tuple[str, ...], key: str) -> None:
    assert key in run(source.parent, "data", "import", "source", "--out", "out", *options, code=2)
    assert not (source.parent / "out").exists()


def skeleton(*arguments: object):
    return CliRunner().invoke(data, ["skeleton", *map(str, arguments)])


@pytest.mark.slow
def test_a_map_is_printed_written_and_shown(tmp_path: Path):
    file = write(tmp_path, walking("lafan1", turned=True).text(), "mine.bvh")
    out, picture = tmp_path / "mine.yaml", tmp_path / "mine.png"
    result = skeleton("guess", file, "--out", out)
    assert result.exit_code == 0
    assert out.read_text() in result.stdout
    assert "with 0 faults" in result.stderr
    assert len(load_skeleton(str(out)).joints) == 22
    assert isinstance(skeleton("guess", file, "--out", out).exception, InputError)
    shown = skeleton("show", file, "--skeleton", out, "--out", picture)
    assert shown.exit_code == 0
    assert shown.stdout.startswith("mine, read from the straightest frame")
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_map_that_does_not_import_fails(tmp_path: Path):
    sample = walking("lafan1", turned=True)
    sample.values[:, 3:] = 0  # nobody stands in the zero pose
    result = skeleton("guess", write(tmp_path, sample.text()))
    assert (result.exit_code, "joints:" in result.stdout) == (1, True)
    assert "cannot be imported" in result.stderr
    for out in ("a.gif", "no/a.png"):
        error = skeleton("show", tmp_path / "none.bvh", "--out", tmp_path / out).exception
        assert isinstance(error, InputError)
        assert str(error).startswith("--out")  # before any work
