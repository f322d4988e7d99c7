"""Values of unknown origin are bounded before they are expanded, and have their types."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypedDict

import pytest

from benchmarks.mutated_runs import BOMB
from memmlp.common.schema import check_type, parse_json, parse_yaml


class Inner(TypedDict):
    a: int


class Outer(TypedDict, total=False):
    inner: Inner | None
    rows: list[dict[str, float]]
    word: Literal["nan"] | float
    name: Annotated[str, str.isalnum]


@pytest.mark.parametrize(("value", "words"), [
    ({"inner": None, "rows": [{"x": 1}], "word": "nan", "name": "a1", "other": object}, None),
    ({"inner": {"a": 1}, "word": 2}, None), ([], "the file must be a mapping"),
    ({"inner": {}}, "inner must have the key a"), ({"inner": {"a": True}}, "inner.a must be a whole number"),
    ({"rows": None}, "rows must be a list"), ({"rows": [{"x": 1}, {"x": "1"}]}, "rows.1.x must be a number"),
    ({"word": "inf"}, "word must be a number"), ({"name": "../x"}, "name must be valid, but is '../x'"),
])  # fmt: skip
def test_types(value: Any, words: str | None):
    if words is None:
        check_type(value, Outer)
    else:
        with pytest.raises(ValueError, match=words):
            check_type(value, Outer)


@pytest.mark.parametrize("text", [
    "[" * 100_000, "[" * 40 + "]" * 40, "NaN", "[1e999]", "[-Infinity]", f"[{10**30}]", r'["\ud800"]',
    r'{"\ud800": 1}', f"[{'1,' * 100_000}1]",
])  # fmt: skip
def test_values_that_no_reader_expects_are_no_json(text: str):
    with pytest.raises(ValueError, match=r".+"):
        parse_json(text)
    assert parse_json('[1e308, "\u00e9", null, {"a": [true, -9000000000]}]')


@pytest.mark.parametrize("text", [
    "a: &a {b: *a}", BOMB, "[" * 9999, "a: 2026-01-02", "1: 2", "a: .inf", "a: !!binary aGk=", "? [a]\n: b",
])  # fmt: skip
def test_yaml_has_neither_aliases_nor_other_types(text: str):
    with pytest.raises(ValueError, match=r".+"):
        parse_yaml(text)
    assert parse_yaml("a: ['*b', 1.5]") == {"a": ["*b", 1.5]}
