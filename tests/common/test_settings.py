"""The rules for the values of keys."""

import dataclasses
from pathlib import Path

import pytest

from memmlp.common.settings import each, existing, existing_clip_folders, one_of, setting, sized, text, within


@pytest.mark.parametrize(("rule", "allowed", "refused"), [
    (one_of("a", "b"), ["a"], ["c", None]), (text(), ["a"], ["", " "]),
    (within(0, 1), [0, 1, 0.5], [-0.1, 1.1, float("nan"), True, "a"]),
    (within(0, 1, "sampled"), [0.5, "sampled"], ["other"]), (each(empty=True), [[], ["a"]], [["a", "a"]]),
    (within(0, strict=True), [0.1], [0, float("inf")]), (each(within(1)), [[1, 2]], [[], [0], [1, 1], [[1]]]),
])  # fmt: skip
def test_a_rule_allows_what_its_words_say(rule, allowed, refused):
    assert [rule.allows(value) for value in allowed] == [True] * len(allowed)
    assert [rule.allows(value) for value in refused] == [False] * len(refused)
    assert rule.words


def test_paths_must_exist(tmp_path: Path):
    (tmp_path / "file").touch()
    assert existing("file").allows(str(tmp_path / "file"))
    assert existing("file", "builtin").allows("builtin")
    assert not existing("folder").allows(str(tmp_path / "file"))
    assert existing_clip_folders().allows([str(tmp_path)])
    assert not existing_clip_folders().allows([str(tmp_path), str(tmp_path)])
    assert not existing_clip_folders().allows([])


def test_defaults_are_chosen_by_the_profile():
    @dataclasses.dataclass
    class Keys:
        a: int = setting(None, tiny=1, small=None, paper=2e-4)
        b: str = setting(None, "x", literal="y")
        c: list = setting(None, [1])

    keys = Keys()
    assert (keys.a, keys.b, keys.c) == ("${size:1,null,0.0002}", "${reading:x,y}", [1])
    assert Keys().c is not keys.c
    assert sized(1, 2, 3, 0.5) == "${size:1,2,3,0.5}"
