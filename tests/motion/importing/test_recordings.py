"""Recordings: which files are found and read, and their true frame rates."""

import hashlib
import os
from dataclasses import replace
from pathlib import Path

import pytest
from bvh_samples import person, refuse, write

from memmlp.common.progress import print_announcements
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


def test_an_index_beside_the_data_has_the_rates(tmp_path: Path) -> None:
    path = write(tmp_path, person("cmu_daz", 3, 0).text(), "60/60_12.bvh")
    other = write(tmp_path, person("cmu_daz", 3, 0).text(), "60/60_13.bvh")
    header = "Subject,Trial #,Motion Description,framerate\n"
    index = write(tmp_path, header + '60,12,"salsa, slow",60\n', "cmu-index.csv")
    relative = path.relative_to(tmp_path)
    assert find_rate(read_bvh(path), relative, {}) == (60, "the rate in cmu-index.csv")
    assert find_rate(read_bvh(path), relative, {"60": 30}).fps == 30
    assert find_rate(read_bvh(path), Path(path.name), {}).fps == 120  # the index is outside of the import
    assert find_rate(read_bvh(other), other.relative_to(tmp_path), {}).fps == 120
    broken = write(tmp_path / "b", person("cmu_daz", 3, 0).text(), "60_12.bvh")
    index = write(tmp_path / "b", header + "60,12,a,0\n", "index.csv")
    with refuse(index, "line 2"):
        find_rate(read_bvh(broken), Path(broken.name), {})


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


def test_linked_folders_are_searched_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """A folder of links to data sets, one of which leads back."""
    write(tmp_path / "cmu", person("cmu_daz", 3, 0).text(), "05/a.bvh")
    (tmp_path / "sets").mkdir()
    for name in ("one", "two"):
        (tmp_path / "sets" / name).symlink_to(tmp_path / "cmu")
    (tmp_path / "cmu" / "back").symlink_to(tmp_path / "sets")
    assert find_recordings(tmp_path / "sets") == {Path("one/05/a.bvh"): tmp_path / "sets/one/05/a.bvh"}
    scan = os.scandir
    monkeypatch.setattr(os, "scandir", lambda path: scan(tmp_path / "none" if "two" in str(path) else path))
    (tmp_path / "sets/two").unlink()
    (tmp_path / "sets/two").mkdir()
    with print_announcements():
        find_recordings(tmp_path / "sets")
    line = f"{tmp_path}/sets/two: cannot be listed (No such file or directory)"
    assert capsys.readouterr().err == f"{line}\n"
