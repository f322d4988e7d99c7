"""Folders: links, suffixes, and what is passed over."""

import os
from pathlib import Path

import pytest

from memmlp.common.errors import InputError
from memmlp.motion.preparing.find_clips import clip_name, find_clips


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name in ("a/1.npz", "a/2.npz", "b/UP.NPZ", "b/LICENSE.txt", "b/README"):
        path = tmp_path / "root" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    return tmp_path / "root"


def test_any_case_of_the_suffix_is_found_and_the_rest_is_counted(root):
    found = find_clips(root)
    assert found.files == ["a/1.npz", "a/2.npz", "b/UP.NPZ"]
    assert found.passed_over == {".txt": 1, "no suffix": 1}
    assert [clip_name(file) for file in found.files] == ["a/1", "a/2", "b/UP"]


def test_hidden_folders_and_files_are_no_data(root):
    """Such as the unfinished clips of an import that was killed, and a server's snapshots."""
    hidden = root / ".cmu-4stpviek" / "clips"
    hidden.mkdir(parents=True)
    (hidden / "1.npz").write_text("unfinished")
    (root / "a" / ".3.npz").write_text("unfinished")
    assert find_clips(root).files == ["a/1.npz", "a/2.npz", "b/UP.NPZ"]


def test_links_in_circles_are_followed_once(root):
    (root / "a" / "loop").symlink_to("..")
    (root / "self").symlink_to(".")
    (root / "endless.npz").symlink_to("endless.npz")
    found = find_clips(root)
    assert found.files == ["a/1.npz", "a/2.npz", "b/UP.NPZ", "endless.npz"]
    assert found.links == {"a/loop": ".", "self": "."}


def test_a_file_of_several_paths_is_found_by_the_shortest_real_one(root):
    os.link(root / "a" / "1.npz", root / "b" / "hard.npz")
    (root / "a" / "0.npz").symlink_to("1.npz")
    (root / "top.npz").symlink_to("a/2.npz")
    (root / "0").symlink_to("a")
    found = find_clips(root)
    assert found.files == ["a/1.npz", "b/UP.NPZ", "top.npz"]
    assert found.links == {"0": "a", "a/0.npz": "a/1.npz", "b/hard.npz": "a/1.npz", "a/2.npz": "top.npz"}


def test_links_out_of_the_folder_count(root, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    (other / "9.npz").write_text("9")
    (root / "c").symlink_to(other)
    assert find_clips(root).files == ["a/1.npz", "a/2.npz", "b/UP.NPZ", "c/9.npz"]


def test_a_folder_without_clips_is_one_line(tmp_path):
    for where in (tmp_path, tmp_path / "none"):
        with pytest.raises(InputError, match=r"data\.root"):
            find_clips(where)
