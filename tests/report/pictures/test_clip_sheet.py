"""Sheets of clips: which clips, how many panels, and what is refused."""

from pathlib import Path

import pytest

from memmlp.common.errors import InputError
from memmlp.motion.formats.npz import write_clip
from memmlp.motion.synthetic import synthesize_clip
from memmlp.report.pictures.clip_sheet import ACROSS, draw_sheet, read_sample
from memmlp.report.pictures.drawing import get_pixels


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    clip = synthesize_clip("walking", 1, seconds=0.5)
    for number in range(7):
        (tmp_path / "clips" / f"{number}").mkdir(parents=True)
        write_clip(tmp_path / "clips" / f"{number}" / "walk.npz", clip)
    return tmp_path / "clips"


@pytest.mark.parametrize(("count", "numbers"), [(1, [0]), (3, [0, 3, 6]), (99, range(7))])
def test_clips_are_evenly_spread(folder: Path, count: int, numbers: list[int]):
    clips, skipped, total = read_sample(folder, count)
    assert [name for name, _ in clips] == [f"{number}/walk" for number in numbers]
    assert (skipped, total) == ([], 7)
    assert clips[0][1].shape[1:] == (22, 3)
    assert read_sample(folder / "2" / "walk.npz", count)[0][0][0] == "walk"


def test_bad_files_are_named(folder: Path, tmp_path: Path):
    (folder / "0" / "walk.npz").write_bytes(b"no")
    clips, (skipped,), _ = read_sample(folder, 7)
    assert (len(clips), skipped.file, str(folder) in skipped.reason) == (6, "0/walk.npz", False)
    with pytest.raises(InputError, match=r"none of 1 files could be read.*0/walk\.npz"):
        read_sample(folder, 1)
    with pytest.raises(InputError, match="No such file"):
        read_sample(tmp_path / "none.npz", 1)


@pytest.mark.slow
def test_a_sheet_has_a_row_for_every_few_clips(folder: Path):
    sheet = get_pixels(draw_sheet(read_sample(folder, 5)[0]))
    height, width = sheet.shape[:2]
    panels = sheet[height // 2 + 30 :].reshape(-1, 3 * ACROSS, width // (3 * ACROSS), 3)
    blank = [(panels[:, number] == 255).all() for number in range(3 * ACROSS)]
    assert blank == [False] * 3 + [True] * 9  # the fifth clip has three panels in the second row
