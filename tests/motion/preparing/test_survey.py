"""Surveys: one bad file never stops a folder, and all that is odd is said."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from memmlp.motion.formats.npz import write_clip
from memmlp.motion.preparing.cache import ClipFolder, prepare_cache
from memmlp.motion.preparing.manifest import Manifest
from memmlp.motion.preparing.splits import ListSplit, SeededSplit
from memmlp.motion.preparing.survey import survey_folder
from memmlp.motion.synthetic import synthesize_clip


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for seed in range(4):
        write_clip(tmp_path / "clips" / "a" / f"{seed}.npz", synthesize_clip("idling", seed, seconds=1))
    return tmp_path / "clips"


def again(source: Path, target: Path) -> None:
    """Save the same frames in double precision, compressed, at another rate and height, in parts."""
    with np.load(source) as old:
        poses, trans = old["poses"].astype(float), old["trans"] + 0.03
    np.savez_compressed(
        target, root_orient=poses[:, :3], pose_body=poses[:, 3:66], trans=trans, mocap_frame_rate=120.0
    )


def test_one_bad_file_never_stops_a_folder(root):
    (root / "text.npz").write_text("no zip")
    (root / "dangling.npz").symlink_to("nowhere")
    os.mkfifo(root / "pipe.npz")
    shutil.copy(root / "a" / "0.npz", root / "line\nfeed.npz")
    shutil.copy(root / "a" / "0.npz", root / "a" / "1.NPZ")
    (root / "directory.npz").mkdir()
    found = survey_folder(root)
    assert {file.file: file.reason.split()[:2] for file in found.skipped} == {
        "text.npz": ["not", "a"], "dangling.npz": ["cannot", "be"], "pipe.npz": ["not", "a"],
        r"line\nfeed.npz": ["the", "name"], "a/1.npz": ["a/1.NPZ", "has"],
    }  # fmt: skip
    assert len(found.clips) == 4
    assert all(file.reason.isprintable() for file in found.skipped)


def test_no_frames_are_in_two_parts_however_they_were_copied(root, tmp_path):
    (root / "loop").symlink_to(".")
    os.link(root / "a" / "0.npz", root / "hard.npz")
    (root / "soft.npz").symlink_to("a/1.npz")
    for name in range(4):
        (root / "b").mkdir(exist_ok=True)
        shutil.copy(root / "a" / f"{name}.npz", root / "b" / f"{name}.npz")
        again(root / "a" / f"{name}.npz", root / "b" / f"again{name}.npz")
    folder = ClipFolder(root, SeededSplit(test=0.3, val=0.3), min_frames=20)
    manifest = prepare_cache(folder, tmp_path / "cache")
    assert manifest == Manifest.load(tmp_path / "cache")
    assert len({clip.content for clip in manifest.clips}) == 4
    assert len({(clip.content, clip.split) for clip in manifest.clips}) == 4
    assert len(manifest.clips) == 12
    assert manifest.duplicates == {}
    assert all(total.clips for total in manifest.totals.values())
    assert len({clip.group for clip in manifest.clips}) == 4


def test_a_list_with_the_same_frames_in_two_parts_keeps_those_of_its_test(root, tmp_path):
    (root / "b").mkdir()
    shutil.copy(root / "a" / "1.npz", root / "b" / "copy.npz")
    for subset, part, names in (("a", "train", [f"a/{n}" for n in range(4)]), ("b", "test", ["b/copy"])):
        folder = tmp_path / "lists" / subset
        folder.mkdir(parents=True)
        for phase in ("train", "test"):
            (folder / f"{phase}_split.txt").touch()
        (folder / f"{part}_split.txt").write_text("".join(f"{name}.npz\n" for name in names))
    clips = ClipFolder(root, ListSplit(tmp_path / "lists"), min_frames=20)
    manifest = prepare_cache(clips, tmp_path / "cache")
    assert manifest.duplicates == {"a/1": "b/copy"}
    assert {clip.name for clip in manifest.clips} == {"a/0", "a/2", "a/3", "b/copy"}
    assert manifest.left_out == {}
    assert manifest.coverage.is_complete
