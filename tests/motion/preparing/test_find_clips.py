"""Folders: links, suffixes, other files, and several folders as one."""

import os
from pathlib import Path

import numpy as np
import pytest

from memmlp.common.errors import InputError
from memmlp.motion.clip import Clip
from memmlp.motion.dataset import MotionDataset, WindowSampler
from memmlp.motion.formats.npz import write_clip
from memmlp.motion.preparing.cache import ClipFolder, prepare_cache
from memmlp.motion.preparing.find_clips import NamedFolders, find_clips, get_clip_name
from memmlp.motion.preparing.splits import MixedSplit, SeededSplit


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name in ("a/1.npz", "a/2.npz", "b/UP.NPZ", "b/LICENSE.txt", "b/README"):
        path = tmp_path / "root" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    return tmp_path / "root"


def test_files_of_any_case_are_found_without_hidden_ones_and_links_in_circles(root):
    (root / ".cmu-4stpviek" / "clips").mkdir(parents=True)
    (root / ".cmu-4stpviek" / "clips" / "1.npz").write_text("unfinished")
    (root / "a" / ".3.npz").write_text("unfinished")
    (root / "a" / "loop").symlink_to("..")
    (root / "self").symlink_to(".")
    (root / "endless.npz").symlink_to("endless.npz")
    found = find_clips(root).files
    assert found == ["a/1.npz", "a/2.npz", "b/UP.NPZ", "endless.npz"]
    assert [get_clip_name(file) for file in found] == ["a/1", "a/2", "b/UP", "endless"]


def test_a_file_of_several_paths_is_found_by_the_shortest_real_one(root, tmp_path):
    os.link(root / "a" / "1.npz", root / "b" / "hard.npz")
    (root / "a" / "0.npz").symlink_to("1.npz")
    (root / "top.npz").symlink_to("a/2.npz")
    (root / "0").symlink_to("a")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "9.npz").write_text("9")
    (root / "c").symlink_to(tmp_path / "other")
    found = find_clips(root)
    assert found.files == ["a/1.npz", "b/UP.NPZ", "c/9.npz", "top.npz"]
    (tmp_path / "empty").mkdir()
    for where in (tmp_path / "empty", tmp_path / "none"):
        with pytest.raises(InputError, match=r"data\.root"):
            find_clips(where)


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """Two folders, of 6 clips of 50 frames and 4 of 80; in the second, pairs belong together."""
    for folder, count, length in (("one", 6, 50), ("two", 8, 80)):
        rng = np.random.default_rng(length)
        for n in range(count):
            poses = 0.05 * np.cumsum(rng.normal(size=(length, 22, 3)), 0)
            clip = Clip("", poses, np.zeros((length, 3)), 60.0)
            write_clip(tmp_path / folder / f"take{n // 2}" / f"{n}.npz", clip)
    return tmp_path


def mixed(home: Path, **names: str) -> ClipFolder:
    split = SeededSplit(test=0.3, val=0.3)
    paired = SeededSplit(test=0.3, val=0.3, groups=["^(take[0-9])/"])
    splits = {name: paired if folder == "two" else split for name, folder in names.items()}
    return ClipFolder(NamedFolders({name: home / names[name] for name in names}), MixedSplit(splits))


def test_each_source_is_split_as_it_is_alone(home):
    manifest = prepare_cache(mixed(home, a="one", b="two"), home / "cache")
    assert manifest.sources == ("a", "b")
    parts = {clip.name: clip.split for clip in manifest.clips}
    alone = prepare_cache(ClipFolder(home / "one", SeededSplit(test=0.3, val=0.3)), home / "alone")
    assert alone.sources == ()
    assert {f"a/{clip.name}": clip.split for clip in alone.clips}.items() <= parts.items()
    assert [name for name in parts if name.startswith("b/")] == [f"b/take{n // 2}/{n}" for n in range(8)]
    for source in ("a", "b"):
        assert {parts[name] for name in parts if name.startswith(source)} == {"train", "val", "test"}
    assert manifest.groups["a/take0/1"] == "a/take0/1"
    assert manifest.groups["b/take0/1"] == "b/take0/0"
    assert all(parts[f"b/take{n}/{2 * n}"] == parts[f"b/take{n}/{2 * n + 1}"] for n in range(4))
    assert prepare_cache(mixed(home, a="one", c="two"), home / "other").digest != manifest.digest


@pytest.mark.parametrize("drawn_by", ["frames", "clips"])
def test_shares_say_how_often_a_window_is_of_each_source(home, drawn_by):
    prepare_cache(mixed(home, a="one", b="two"), home / "cache")
    dataset = MotionDataset.open(home / "cache", "train")
    assert dataset.sources == [name.split("/")[0] for name in dataset.names]
    sources = np.array(dataset.sources)

    def drawn(shares):
        sampler = WindowSampler(dataset, 4000, 41, 0, drawn_by, shares)
        return np.bincount(sampler.draw(0)[0].numpy(), minlength=len(dataset)) / 4000

    even = drawn(None)
    for shares in ({"a": 1.0, "b": 1.0}, {"a": 3.0, "b": 1.0}):
        found = drawn(shares)
        for source, share in shares.items():
            assert found[sources == source].sum() == pytest.approx(share / sum(shares.values()), abs=0.03)
            own = found[sources == source] / found[sources == source].sum()
            assert own == pytest.approx(even[sources == source] / even[sources == source].sum(), abs=0.05)
    assert abs(even[sources == "a"].sum() - 0.75) > 0.1
