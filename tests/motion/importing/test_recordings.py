"""True frame rates: given, beside the data, known of a file, or the header's."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from bvh_samples import person, refuse, write

from memmlp.common.errors import InputError
from memmlp.motion.formats.expmap import WIDTH
from memmlp.motion.importing.fidelity import Fidelity
from memmlp.motion.importing.import_folder import ImportSettings, import_folder, verify_folder
from memmlp.motion.importing.recordings import (
    DIGITS,
    SIDECAR,
    Rate,
    find_recordings,
    read_recording,
    states_rate,
    true_rate,
)

SALSA = Path(__file__).parents[3] / ".." / "shared" / "data" / "cmu" / "salsa"
KNOWN = b"HIERARCHY\r\nMOTION\n"  # stands for a file of CMU's salsa, with mixed ends of lines as theirs


@pytest.fixture(autouse=True)
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    digest = hashlib.sha256(b"HIERARCHY\nMOTION\n").hexdigest()
    monkeypatch.setattr("memmlp.motion.importing.recordings._known_rates", lambda: {digest[:DIGITS]: 60.0})


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
    ["", "fps: fast", "fps: 0", "fps: true", "fps: .nan", "fps: 60\nunit: 1", "["],
)
def test_damaged_sidecars_are_refused(tmp_path: Path, text: str) -> None:
    path = write(tmp_path, text, SIDECAR)
    with refuse(path):
        rate(tmp_path, {})


# Which files are taken for recordings, and exponential maps through the whole import


def standing(frames: int = 40) -> str:
    """Exponential maps of a person who stands; the head nods."""
    values = np.zeros((frames, WIDTH))
    values[:, 3 + 3 * 16] = 0.3 * np.sin(np.arange(frames) / 10)
    return "\n".join(",".join(map(repr, row)) for row in values.tolist()) + "\n"


def test_other_text_is_passed_over(tmp_path: Path) -> None:
    write(tmp_path / "all", standing(), "walking_1.txt")
    write(tmp_path / "all", "Notes on the recordings, by hand.", "README.txt")
    write(tmp_path / "all", person("cmu_daz", 3, 0).text(), "deep/A.BVH")
    assert [path.as_posix() for path in find_recordings(tmp_path / "all")] == ["deep/A.BVH", "walking_1.txt"]
    with refuse(tmp_path / "all" / "README.txt", "no recording found"):
        find_recordings(tmp_path / "all" / "README.txt")
    assert not states_rate(tmp_path / "all" / "walking_1.txt")
    assert len(read_recording(tmp_path / "all" / "deep" / "A.BVH")) == 3


def test_exponential_maps_are_imported_at_the_rate_that_is_told(tmp_path: Path) -> None:
    path = write(tmp_path, standing(), "nod.txt")
    with refuse(path, "--fps HZ"):
        import_folder(path, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    report = import_folder(path, tmp_path / "out", ImportSettings(fps={"": 60.0}))
    assert (report.clips[0].fps, report.clips[0].frames, report.clips[0].faults) == (60.0, 39, ())
    assert json.loads((tmp_path / "out" / "import.json").read_text())["clips"][0]["source"] == "nod.txt"
    [fidelity] = verify_folder(path)
    assert isinstance(fidelity, Fidelity)
    assert fidelity.faults == ()


def test_a_rate_beside_the_file_will_do(tmp_path: Path) -> None:
    path = write(tmp_path / "in", standing(), "nod.txt")
    write(tmp_path / "in", "fps: 120", "motion.yaml")
    assert import_folder(path.parent, tmp_path / "out").clips[0].fps == 120.0


def test_damage_is_one_line(tmp_path: Path) -> None:
    lines = standing().splitlines()
    path = write(tmp_path, "\n".join([*lines[:5], "1,2,3"]), "cut.txt")
    with pytest.raises(InputError, match=r"cut\.txt: line 6: "):
        read_recording(path)
