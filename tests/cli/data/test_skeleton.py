"""`memmlp data skeleton`: a map proposed, written once, and its picture."""

from __future__ import annotations

from pathlib import Path

import pytest
from bvh_samples import write
from click.testing import CliRunner
from skeleton_families import anonymous, walking

from memmlp.cli.data import data
from memmlp.common.errors import InputError
from memmlp.motion.importing.skeleton_map import load_skeleton


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Make a file of an unknown skeleton."""
    sample = walking("lafan1", turned=True)
    names = anonymous(sample.hierarchy())
    sample.names = [names[name] for name in sample.names]
    return write(tmp_path, sample.text(), "mine.bvh")


def run(*arguments: object):
    return CliRunner().invoke(data, ["skeleton", *map(str, arguments)])


@pytest.mark.slow
def test_a_map_is_printed_written_and_shown(file: Path, tmp_path: Path):
    out, picture = tmp_path / "mine.yaml", tmp_path / "mine.png"
    result = run("guess", file, "--out", out)
    assert result.exit_code == 0
    assert out.read_text() in result.stdout
    assert "with 0 faults" in result.stderr
    assert len(load_skeleton(str(out)).joints) == 22
    shown = run("show", file, "--skeleton", out, "--out", picture)
    assert shown.exit_code == 0
    assert shown.stdout.startswith("mine, read from frame")
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_an_existing_map_is_not_replaced(file: Path, tmp_path: Path):
    out = write(tmp_path, "mine", "mine.yaml")
    result = run("guess", file, "--out", out)
    assert isinstance(result.exception, InputError)
    assert out.read_text() == "mine"


def test_a_map_that_does_not_import_fails(tmp_path: Path):
    sample = walking("lafan1", turned=True)
    sample.values[:, 3:] = 0  # nobody stands in the zero pose
    result = run("guess", write(tmp_path, sample.text()))
    assert result.exit_code == 1
    assert "joints:" in result.stdout
    assert "does not do yet" in result.stderr


@pytest.mark.parametrize("out", ["a.gif", "no/a.png"])
def test_pictures_that_cannot_be_are_refused_before_any_work(tmp_path: Path, out: str):
    result = run("show", tmp_path / "none.bvh", "--out", tmp_path / out)
    assert isinstance(result.exception, InputError)
    assert str(result.exception).startswith("--out")
