"""The source of an experiment's motion: what is refused of a list that isn't all there."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from memmlp.common.errors import InputError
from memmlp.motion.clip import Clip
from memmlp.motion.formats.npz import write_clip
from memmlp.motion.motion_source import MotionSource
from memmlp.motion.preparing import survey as survey_module
from memmlp.motion.preparing.cache import ClipFolder
from memmlp.motion.preparing.splits import ListSplit, SeededSplit, SubsetSplit

NAMES = [f"{subset}/0{n}/take" for subset in ("CMU", "HDM05") for n in range(1, 5)]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name in NAMES:
        write_clip(tmp_path / "amass" / f"{name}_stageii.npz", still(50))
    for subset, first in (("CMU", "CMU"), ("HDM05", "MPI_HDM05")):
        lists = tmp_path / "lists" / first
        lists.mkdir(parents=True)
        lines = [name.replace(subset, first) + "_poses.npz\n" for name in NAMES if name.startswith(subset)]
        (lists / "train_split.txt").write_text("".join(lines[:3]))
        (lists / "test_split.txt").write_text(lines[3])
    return tmp_path / "amass"


def still(frames: int) -> Clip:
    return Clip("", np.zeros((frames, 22, 3)), np.zeros((frames, 3)), 60.0)


def source(root: Path, split, **changes) -> MotionSource:
    return MotionSource(ClipFolder(root, split), None, root.with_name("cache"), **changes)


def listed(root: Path, **changes) -> MotionSource:
    return source(root, ListSplit(root.with_name("lists"), val=0.2), **changes)


def test_a_whole_list_is_whole_until_a_clip_is_damaged(root):
    manifest = listed(root).prepare().manifest
    assert manifest.coverage.is_complete
    assert manifest.coverage.counts == (8, 8)
    assert (manifest.missing, manifest.listed) == ((), {"CMU": 4, "MPI_HDM05": 4})
    assert len(manifest.clips) == 8
    write_clip(root / f"{NAMES[0]}_stageii.npz", still(20))
    assert listed(root).prepare().manifest.coverage.is_complete
    (root / f"{NAMES[1]}_stageii.npz").write_bytes(b"PK broken")
    with pytest.raises(InputError, match=r"1 of 8 .*\(CMU 1 of 4\)"):
        listed(root).prepare()
    manifest = listed(root, partial=True).prepare().manifest
    assert manifest.missing == ("CMU/02/take_poses",)


def test_one_missing_clip_is_said_before_any_is_read(root, monkeypatch):
    (root / f"{NAMES[5]}_stageii.npz").unlink()
    with monkeypatch.context() as patch:
        patch.setattr(survey_module, "read_clip", lambda *args: pytest.fail("read a clip"))
        with pytest.raises(InputError, match=r"1 of 8 .*\(MPI_HDM05 1 of 4\).*data.partial=true") as error:
            listed(root).prepare()
    assert "\n" not in str(error.value)
    assert not root.with_name("cache").exists()
    manifest = listed(root, partial=True).prepare().manifest
    assert str(manifest.coverage) == "87 % of the list (7 of 8 entries)"
    assert manifest.missing == ("MPI_HDM05/02/take_poses",)
    with pytest.raises(InputError, match="1 of 8"):
        listed(root).prepare()  # though its cache is finished
    assert listed(root).find_digest() == manifest.digest  # tables find what was trained on it


def test_a_missing_subset_is_said_and_a_seeded_split_has_no_list(root):
    with pytest.raises(InputError, match=r"1 of 3 .*\(SFU 1 of 1\)"):
        source(root, SubsetSplit(["CMU", "SFU"], ["MPI_HDM05"])).prepare()
    for split in (SubsetSplit(["CMU"], ["MPI_HDM05"]), SeededSplit()):
        assert source(root, split).prepare().manifest.coverage.is_complete


def test_nothing_goes_on_with_clips_that_are_others_by_now(root):
    """What was trained on one set of clips would be tested on another, under the first one's digest."""
    changing = source(root, SeededSplit(test=0.2, val=0.2))
    before = changing.prepare()
    assert len(before.open("train")) > 0
    write_clip(root / f"{NAMES[0]}_stageii.npz", still(60))
    now = changing.prepare()
    assert len(now.open("train")) > 0
    with pytest.raises(InputError, match="other clips"):
        before.open("train")


def test_a_full_disk_leaves_no_half_of_synthetic_motion(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    root, write, room = tmp_path / "synth", np.savez, [2]

    def save(file, **arrays) -> None:
        room[0] -= 1
        if room[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(file, **arrays)

    def generate(folder: Path) -> None:
        for name in "abcd":
            write_clip(folder / f"{name}/{name}.npz", still(50))

    split = SeededSplit(val=0.3, test=0.3)
    made = MotionSource(ClipFolder(root, split), generate, tmp_path / "cache")
    monkeypatch.setattr(np, "savez", save)
    with pytest.raises(OSError, match=r"No space left on device: '.*c\.npz'"):
        made.prepare()
    assert [path for path in tmp_path.rglob("*") if ".lease-" not in path.name] == []
    room[0] = 4
    assert len(made.prepare().manifest.clips) == 4
