"""Remarks on clips in training and in test that may belong together."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from memmlp.motion.preparing.split_remarks import divided_remark, unmatched_patterns_remark


def manifest_of(parts: Sequence[tuple[str, str]], split: dict[str, Any], tied: Sequence[str] = ()) -> Any:
    """A manifest with clips in parts; those of `tied` are in one group."""
    clips = [
        SimpleNamespace(name=name, split=part, group="tied" if name in tied else name) for name, part in parts
    ]
    return SimpleNamespace(clips=clips, split=split)


@pytest.mark.parametrize(
    ("names", "split", "said"),
    [
        (("CMU/01/a", "CMU/01/b", "KIT/3/a", "KIT/3/b"), {}, "clips of CMU/01 and 1 more are in"),
        (("BMLrub/BioMotionLab_NTroje/7/a", "BMLrub/BioMotionLab_NTroje/7/b"), {}, "clips of BioMotion"),
        (("amass/CMU/01/a", "amass/CMU/01/b"), {}, "clips of CMU/01 are in"),
        (("h/BioMotionLab_NTroje/rub001/a_poses", "x/BMLrub/rub001/a_stageii"), {}, "clips of BioMotionLab_"),
        (("Eyes_Japan_Dataset/A B/a", "EyesJapanDataset/A_B/b"), {}, "clips of Eyes_Japan_Dataset/A B are"),
        (("CMU/01/a", "CMU/02/b"), {}, None),
        (("CMU/a", "CMU/b", "mine/01/a", "mine/01/b"), {}, None),
        (("CMU/01/a", "CMU/01/b"), {"kind": "lists"}, None),
        (("cmu/salsa/01", "cmu/salsa/02"), {"sources": {"cmu": {}}}, None),
    ],
)
def test_a_split_that_tests_on_the_people_that_it_trains_on_says_so(names, split, said):
    parts = list(zip(names, itertools.cycle(["train", "test"])))
    found = divided_remark(manifest_of(parts, split, tied=names))
    assert found.startswith(said) if said else found == ""


SOURCES: dict[str, Any] = {"sources": {"x": {}, "y": {}}}
TAKES = [("own/anna/1", "train"), ("own/anna/2", "test"), ("own/ben/1", "test"), ("own/ben/2", "train")]
FLAT = [("salsa/1", "train"), ("salsa/2", "test"), ("own/1", "train"), ("own/2", "test")]  # salsa is tied
SESSIONS = [(f"{name.rpartition('/')[0]}/session{name[-1]}/take", part) for name, part in TAKES]


@pytest.mark.parametrize(
    ("parts", "split", "said"),
    [
        (TAKES, {"groups": ["salsa/(.*)"]}, "2 test clips are tied to no others"),
        (TAKES, {}, "2 test clips are tied to no others"),
        (TAKES, {"groups": ["own/(.*?)/"]}, ""),
        (TAKES[:2], {}, ""),  # all in one folder, which is no person
        ([("a/1", "train"), ("a/2", "val"), ("b/1", "test")], {}, ""),
        ([(f"x/{name}", part) for name, part in TAKES], SOURCES, "2 test clips"),
        (FLAT, {"groups": ["salsa/(.*)"]}, "1 test clips are tied to no others"),
        (SESSIONS, {}, "2 test clips are tied to no others"),
        ([("c1/a", "train"), ("c2/a", "test"), ("c3/a", "train")], {}, ""),  # no folder is shared
    ],
)
def test_folders_with_clips_in_training_and_in_test_are_told(parts, split, said):
    """A folder is often a person, and no shipped pattern knows a custom folder."""
    found = divided_remark(manifest_of(parts, split))
    assert found.startswith(said) if said else found == ""
    assert not divided_remark(manifest_of(parts, split | {"kind": "lists"}))
    tied = [name for name, _ in parts]  # by a column file
    assert not divided_remark(manifest_of(parts, split, tied))
    if "sources" in split and said:
        assert "x/own/anna and 1 more, are in training" in found


def test_patterns_without_a_match_are_reported():
    split = {"groups": ["^(S[0-9])_", "^([^/]+/[^/]+)/take"]}
    remark = unmatched_patterns_remark(split, ["ann/1", "ben/2"])
    assert "2 patterns" in remark
    assert "^(S[0-9])_" in remark
    assert unmatched_patterns_remark(split, ["ann/1", "S1_2"]) == ""
    assert unmatched_patterns_remark({"groups": []}, ["ann/1"]) == ""
    assert unmatched_patterns_remark(split, ["CMU/CMU/01/take1"]) == ""
    mixed = {"kind": "mixed", "sources": {"one": split, "two": {"groups": ["(ann)"]}}}
    assert unmatched_patterns_remark(mixed, ["one/ann/1", "two/ann/2"]).startswith("one: ")
