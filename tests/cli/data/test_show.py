"""`memmlp data show`: a sheet of clips."""

from __future__ import annotations

from pathlib import Path

from click.testing import CliRunner

from memmlp.cli.data import data
from memmlp.common.errors import InputError
from memmlp.motion.formats.npz import write_clip
from memmlp.motion.synthetic import synthesize_clip


def test_a_sheet_is_written_and_bad_files_are_named(tmp_path: Path):
    for name in ("a", "b"):
        write_clip(tmp_path / f"{name}.npz", synthesize_clip("walking", 1, seconds=0.5))
    (tmp_path / "c.npz").write_bytes(b"no")
    out = tmp_path / "sheet.png"
    result = CliRunner().invoke(data, ["show", str(tmp_path), "--out", str(out)])
    assert result.exit_code == 0
    assert "skipped c.npz: " in result.output
    assert f"2 of 3 clips: {out}" in result.output
    assert out.read_bytes().startswith(b"\x89PNG")


def test_other_pictures_are_refused(tmp_path: Path):
    result = CliRunner().invoke(data, ["show", str(tmp_path), "--out", str(tmp_path / "sheet.gif")])
    assert isinstance(result.exception, InputError)
    assert "must end in .png" in str(result.exception)
