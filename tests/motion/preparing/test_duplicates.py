"""Clips of the same frames: in one part, and one group."""

from memmlp.motion.preparing.duplicates import one_part_each, tied
from memmlp.motion.preparing.manifest import STILL, ClipRecord

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
