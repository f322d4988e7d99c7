"""Clips of the same frames: in one part, and one group."""

from collections import Counter
from unittest import mock

import pytest

from memmlp.motion.preparing.duplicates import assign, one_part_each, tied
from memmlp.motion.preparing.manifest import STILL, ClipRecord
from memmlp.motion.preparing.splits import Assignment, MixedSplit, SeededSplit

CONTENTS = {"a": "x", "b": "y", "c": "x", "d": "x", "e": "y", "f": "z", "g": STILL, "h": STILL}


def clips() -> list[ClipRecord]:
    return [ClipRecord(name, "", "", "", 0, 9, "", of, 60.0, "kept") for name, of in CONTENTS.items()]


def test_training_gives_way_to_validation_and_both_to_testing():
    parts = {"a": "train", "b": "val", "c": "test", "d": "val", "e": "train", "f": "train"}
    kept, gave_way = one_part_each(clips(), parts | {"g": "train", "h": "test"})
    assert kept == parts | {"a": None, "d": None, "e": None, "g": "train", "h": "test"}
    assert gave_way == {"a": "c", "d": "c", "e": "b"}


def test_copies_in_one_part_stay_and_what_has_no_part_gets_none():
    parts = dict.fromkeys(CONTENTS, "train") | {"c": None}
    assert one_part_each(clips(), parts) == (parts, {})


def test_groups_with_copies_are_one():
    groups = {"a": "a", "b": "b", "c": "c", "d": "d", "e": "d", "f": "f", "g": "c", "h": "h"}
    assert tied(clips(), groups) == {
        "a": "a", "b": "a", "c": "a", "d": "a", "e": "a", "f": "f", "g": "a", "h": "h",
    }  # fmt: skip


def test_a_published_list_is_kept_although_copies_join_its_groups():
    """A copy on the other side is left out; nothing is drawn anew."""
    given = Assignment(dict.fromkeys(CONTENTS, "train") | {"c": "test"}, {name: name for name in CONTENTS})
    split = mock.Mock(listed={"CMU": 8}, assign=mock.Mock(return_value=given))
    parts, groups, gave_way = assign(split, clips())
    assert parts == given.parts | {"a": None, "d": None}
    assert gave_way == {"a": "c", "d": "c"}
    assert groups["d"] == "a"
    assert split.assign.call_count == 1


@pytest.mark.parametrize("source", ["", "cmu/"])
@pytest.mark.parametrize("copy", [False, True])
def test_a_copy_leaves_the_limit_of_clips_of_a_group(source: str, copy: bool):
    """Twelve takes of ten clips each; one clip of the first take is there again in the second."""
    names = [f"{source}take{take:02}/{clip}" for take in range(12) for clip in range(10)]
    contents = {name: name for name in names}
    if copy:
        contents[names[10]] = names[0]
    records = [ClipRecord(name, "", "", "", 0, 9, "", of, 60.0, "kept") for name, of in contents.items()]
    own = SeededSplit(0.2, 0.2, 0, ["(take..)/"], per_group=2)
    parts, groups, gave_way = assign(MixedSplit({"cmu": own}) if source else own, records)
    held_out = Counter((groups[name], part) for name, part in parts.items() if part in ("val", "test"))
    assert {part for _, part in held_out} == {"val", "test"}
    assert set(held_out.values()) == {2}
    assert groups[names[10]] == (groups[names[0]] if copy else names[10])
    assert gave_way == {}
