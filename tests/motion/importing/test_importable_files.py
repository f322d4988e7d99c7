"""Which files are taken for recordings, and exponential maps through the whole import."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from bvh_samples import person, refuse, write

from memmlp.common.errors import InputError
from memmlp.motion.formats.expmap import WIDTH
from memmlp.motion.importing.import_folder import ImportSettings, import_folder
from memmlp.motion.importing.importable_files import find_recordings, read_recording, tells_rate
from memmlp.motion.importing.verify_files import verify


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
    assert not tells_rate(tmp_path / "all" / "walking_1.txt")
    assert len(read_recording(tmp_path / "all" / "deep" / "A.BVH")) == 3


def test_exponential_maps_are_imported_at_the_rate_that_is_told(tmp_path: Path) -> None:
    path = write(tmp_path, standing(), "nod.txt")
    with refuse(path, "this format tells no frame rate", "--fps HZ, 120 for the published files"):
        import_folder(path, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    report = import_folder(path, tmp_path / "out", ImportSettings(fps={"": 60.0}))
    assert (report.clips[0].fps, report.clips[0].frames, report.clips[0].faults) == (60.0, 39, ())
    assert json.loads((tmp_path / "out" / "import.json").read_text())["clips"][0]["source"] == "nod.txt"
    assert verify(path).faults == ()


def test_a_rate_beside_the_file_will_do(tmp_path: Path) -> None:
    path = write(tmp_path / "in", standing(), "nod.txt")
    write(tmp_path / "in", "fps: 120", "motion.yaml")
    assert import_folder(path.parent, tmp_path / "out").clips[0].fps == 120.0


def test_damage_is_one_line(tmp_path: Path) -> None:
    lines = standing().splitlines()
    path = write(tmp_path, "\n".join([*lines[:5], "1,2,3"]), "cut.txt")
    with pytest.raises(InputError, match=r"cut\.txt: line 6: "):
        read_recording(path)
