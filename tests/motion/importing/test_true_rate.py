"""True frame rates: given, beside the data, known of a file, or the header's."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
from bvh_samples import refuse, write

from memmlp.motion.importing.true_rate import DIGITS, SIDECAR, Rate, true_rate

SALSA = Path(__file__).parents[3] / ".." / "shared" / "data" / "cmu" / "salsa"
KNOWN = b"HIERARCHY\r\nMOTION\n"  # stands for a file of CMU's salsa, with mixed ends of lines as theirs


@pytest.fixture(autouse=True)
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    digest = hashlib.sha256(b"HIERARCHY\nMOTION\n").hexdigest()
    monkeypatch.setattr("memmlp.motion.importing.true_rate._known", lambda: {digest[:DIGITS]: 60.0})


def rate(top: Path, told: dict[str, float], content: bytes = b"", file: str = "dance/salsa/01.bvh") -> Rate:
    return true_rate(120.0, Path(file), content, top, told)


def test_the_header_is_last(tmp_path: Path) -> None:
    assert rate(tmp_path, {}) == (120, "the header's")
    assert rate(tmp_path, {}, KNOWN) == (60, "known of this file")
    write(tmp_path, "fps: 50", f"dance/{SIDECAR}")
    assert rate(tmp_path, {}, KNOWN) == (50, "in dance/motion.yaml")
    assert rate(tmp_path, {"": 40}, KNOWN) == (40, "given for all")
    assert rate(tmp_path, {"dance": 30, "": 40}, KNOWN) == (30, "given for dance")


def test_a_file_is_known_whatever_the_ends_of_its_lines(tmp_path: Path) -> None:
    for content in (KNOWN.replace(b"\r\n", b"\n"), KNOWN.replace(b"\r\n", b"\n").replace(b"\n", b"\r\n")):
        assert rate(tmp_path, {}, content) == (60, "known of this file")
    assert rate(tmp_path, {}, KNOWN + b" ") == (120, "the header's")


@pytest.mark.skipif(not SALSA.is_dir(), reason="no CMU salsa in ../shared/data")
def test_cmus_salsa_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    found = {rate(tmp_path, {}, path.read_bytes()) for path in SALSA.glob("*.bvh")}
    assert found == {(60, "known of this file")}


def test_the_nearest_folder_counts(tmp_path: Path) -> None:
    for folder, fps in (("", 30), ("dance/", 50), ("dance/salsa/", 60)):
        write(tmp_path, f"fps: {fps}", folder + SIDECAR)
    assert rate(tmp_path, {}) == (60, "in dance/salsa/motion.yaml")
    assert rate(tmp_path, {}, file="dance/tango/01.bvh") == (50, "in dance/motion.yaml")
    assert rate(tmp_path, {}, file="01.bvh") == (30, "in motion.yaml")


@pytest.mark.parametrize(
    "text",
    ["", "fps", "fps: fast", "fps: 0", "fps: 1e9", "fps: true", "fps: .nan", "fps: 60\nunit: 1", "[", "\0"],
)
def test_damaged_sidecars_are_refused(tmp_path: Path, text: str) -> None:
    path = write(tmp_path, text, SIDECAR)
    with refuse(path):
        rate(tmp_path, {})
