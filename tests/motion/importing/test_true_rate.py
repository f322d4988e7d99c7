"""True frame rates: given, beside the data, known of a file, or the header's."""

from __future__ import annotations

from pathlib import Path

import pytest
from bvh_samples import refuse, write

from memmlp.motion.importing.true_rate import SIDECAR, Rate, true_rate

KNOWN = "e54cdd79f5457acf" + 48 * "0"  # a file of CMU's salsa


def rate(top: Path, told: dict[str, float], sha256: str = 64 * "0", file: str = "dance/salsa/01.bvh") -> Rate:
    return true_rate(120.0, Path(file), sha256, top, told)


def test_the_header_is_last(tmp_path: Path) -> None:
    assert rate(tmp_path, {}) == (120, "the header's")
    assert rate(tmp_path, {}, KNOWN) == (60, "known of this file")
    write(tmp_path, "fps: 50", f"dance/{SIDECAR}")
    assert rate(tmp_path, {}, KNOWN) == (50, "in dance/motion.yaml")
    assert rate(tmp_path, {"": 40}, KNOWN) == (40, "given for all")
    assert rate(tmp_path, {"dance": 30, "": 40}, KNOWN) == (30, "given for dance")


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
