"""Recordings: which files are found and read, and their true frame rates."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import pytest
from bvh_samples import person, refuse, write

from memmlp.motion.formats.bvh import read_bvh
from memmlp.motion.importing.recordings import DIGITS, find_rate, find_recordings, read_recording

SALSA = Path(__file__).parents[3] / ".." / "shared" / "data" / "cmu" / "salsa"


def test_the_header_is_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file is known whatever the ends of its lines."""
    path = write(tmp_path, person("cmu_daz", 3, 0).text("\r\n"))
    recording, relative = read_bvh(path), Path("dance/salsa/01.bvh")
    assert find_rate(recording, relative, {}) == (120, "the header's")
    digest = hashlib.sha256(path.read_bytes().replace(b"\r\n", b"\n")).hexdigest()[:DIGITS]
    known = "memmlp.motion.importing.recordings._load_known_rates"
    monkeypatch.setattr(known, lambda: {digest: 60.0})
    assert find_rate(recording, relative, {}) == (60, "the known true rate of this file")
    assert find_rate(recording, relative, {"": 40}) == (40, "set for all")
    assert find_rate(recording, relative, {"dance": 30, "": 40}) == (30, "set for dance")
    monkeypatch.setattr(known, dict)
    assert find_rate(replace(recording, fps=None), relative, {}).fps == 120  # an AMC's
    assert find_rate(replace(recording, fps=None), relative, {"": 60}).fps == 60


@pytest.mark.skipif(not SALSA.is_dir(), reason="no CMU salsa in ../shared/data")
def test_cmus_salsa_is_known() -> None:
    paths = sorted(SALSA.glob("*.bvh"))[::10]
    found = {find_rate(read_bvh(path), Path(path.name), {}) for path in paths}
    assert found == {(60, "the known true rate of this file")}


def test_other_files_are_passed_over(tmp_path: Path) -> None:
    write(tmp_path / "all", "Notes on the recordings, by hand.", "README.txt")
    write(tmp_path / "all", person("cmu_daz", 3, 0).text(), "deep/A.BVH")
    assert [path.as_posix() for path in find_recordings(tmp_path / "all")] == ["deep/A.BVH"]
    for action in (find_recordings, read_recording):
        with refuse(tmp_path / "all" / "README.txt", "expected a .bvh or .amc file"):
            action(tmp_path / "all" / "README.txt")
    assert len(read_recording(tmp_path / "all" / "deep" / "A.BVH")) == 3
