"""Column files of groups, and remarks on clips that may belong together."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from memmlp.common.errors import InputError
from memmlp.motion.preparing.groups import (
    describe_divided_folders,
    describe_unmatched_patterns,
    read_groups,
)
from memmlp.motion.preparing.splits import SeededSplit


def grouped(patterns, file):
    return SeededSplit(groups=patterns, groups_file=file).grouping


def written(folder, text):
    file = folder / "groups.csv"
    file.write_text(text, encoding="utf-8")
    return file


def test_groups_are_read_and_named(tmp_path):
    file = written(tmp_path, "\ufeffsession,group,clip\n1,ann,./a/1.npz\n2, ben ,b/2\n")
    assert read_groups(file) == {"a/1": "ann", "b/2": "ben"}
    rows = grouped(["^(x)"], written(tmp_path, "clip,group\na,ann\nb,ann\nx1,ben\nx2,cy\n"))
    seen = {name: name for name in ("b", "a", "x2", "x1")}
    assert rows.name_groups(seen) == {"a": "ann", "b": "ann", "x1": "ben", "x2": "ben"}
    found = grouped(["^(x)"], None).name_groups(seen)
    assert found == {"a": "a", "b": "b", "x1": "x1", "x2": "x1"}


@pytest.mark.parametrize(("text", "said"), [
    ("clip,subject\na,b\n", "no column group"), ("", "no column clip"),
    ("clip,group\na,1\nb,\n", "line 3 lacks"), ("clip,group\na\n", "line 2 lacks"),
    ("clip,group\na,1\na.npz,2\n", "line 3 gives a"),
])  # fmt: skip
def test_bad_files_in_one_line(tmp_path, text, said):
    with pytest.raises(InputError, match=rf"\A.*{said}.*\Z"):
        read_groups(written(tmp_path, text))
    with pytest.raises(InputError, match="groups_file"):
        read_groups(tmp_path / "none.csv")


def test_clips_without_a_row_and_rows_without_a_clip_are_named(tmp_path):
    grouping = grouped([], written(tmp_path, "clip,group\na,1\nb,1\nc,2\n"))
    grouping.check(["a", "b"], ["a", "b", "c"])  # c has a file that can't be used
    with pytest.raises(InputError, match="d and 1 more"):
        grouping.check(["a", "d", "e"], ["a", "b", "c", "d", "e"])
    with pytest.raises(InputError, match=r"data\.root.* c$"):
        grouping.check(["a", "b"], ["a", "b"])
    grouped([], None).check(["a"], [])


def manifest_of(parts: Sequence[tuple[str, str]], split: dict[str, Any], tied: Sequence[str] = ()) -> Any:
    """A manifest with clips in parts; those of `tied` are in one group."""
    clips = [SimpleNamespace(name=n, split=part, group="tied" if n in tied else n) for n, part in parts]
    return SimpleNamespace(clips=clips, split=split)


SOURCES: dict[str, Any] = {"sources": {"x": {}, "y": {}}}
TAKES = [("own/anna/1", "train"), ("own/anna/2", "test"), ("own/ben/1", "test"), ("own/ben/2", "train")]
FLAT = [("salsa/1", "train"), ("salsa/2", "test"), ("own/1", "train"), ("own/2", "test")]  # salsa is tied
SESSIONS = [(f"{name.rpartition('/')[0]}/session{name[-1]}/take", part) for name, part in TAKES]


@pytest.mark.parametrize(("parts", "split", "said"), [
    (TAKES, {"groups": ["salsa/(.*)"]}, "2 test clips share no group with other clips"),
    (TAKES, {"groups": ["own/(.*?)/"]}, ""),
    (TAKES[:2], {}, ""),  # all in one folder, which is no person
    ([(f"x/{name}", part) for name, part in TAKES], SOURCES, "2 test clips"),
    (FLAT, {"groups": ["salsa/(.*)"]}, "1 test clips share no group with other clips"),
    (SESSIONS, {}, "2 test clips share no group with other clips"),
])  # fmt: skip
def test_folders_with_clips_in_training_and_in_test_are_told(parts, split, said):
    """A folder is often a person, and no shipped pattern knows a custom folder."""
    found = describe_divided_folders(manifest_of(parts, split))
    assert found.startswith(said) if said else found == ""
    assert not describe_divided_folders(manifest_of(parts, split | {"kind": "lists"}))
    tied = [name for name, _ in parts]  # by a column file
    assert not describe_divided_folders(manifest_of(parts, split, tied))
    if "sources" in split and said:
        assert "the same folders (x/own/anna and 1 more)" in found


def test_patterns_without_a_match_are_reported():
    split = {"groups": ["^(S[0-9])_", "^([^/]+/[^/]+)/take"]}
    remark = describe_unmatched_patterns(split, ["ann/1", "ben/2"])
    assert "2 patterns" in remark
    assert "^(S[0-9])_" in remark
    assert describe_unmatched_patterns(split, ["ann/1", "S1_2"]) == ""
    assert describe_unmatched_patterns({"groups": []}, ["ann/1"]) == ""
    assert describe_unmatched_patterns(split, ["CMU/CMU/01/take1"]) == ""
    mixed = {"kind": "mixed", "sources": {"one": split, "two": {"groups": ["(ann)"]}}}
    assert describe_unmatched_patterns(mixed, ["one/ann/1", "two/ann/2"]).startswith("one: ")
