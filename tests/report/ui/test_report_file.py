"""What `memmlp report` puts into the page's file."""

from typing import Any
from unittest.mock import MagicMock

from memmlp.report.ui.report_file import _select_sweeps, _shorten_run_page, encode_query, round_numbers


def clip(name: str, error: Any) -> dict[str, Any]:
    """A clip's row, whose errors files hold as numbers or as words such as nan."""
    return {"name": name, "stream": {"rotation": {"MPJPE": error}}}


def test_clips_without_a_number_are_the_worst():
    clips = [clip("good", 3.0), clip("nan", "nan"), clip("bad", 9.0), {"name": "none"}, clip("inf", "inf")]
    kept = _shorten_run_page({"clips": clips, "manifest": {}, "log": ""})["clips"]
    assert [one["name"] for one in kept] == ["nan", "inf", "bad", "good", "none"]


def test_names_choose_sweeps():
    answers = MagicMock(**{"sweeps.known": {"table05-a": "a", "table05-b": "b", "mine": "m"}})
    for names, shown in (([], "abm"), (["5"], "ab"), (["x/mine.yaml", "table05-b"], "mb")):
        assert "".join(_select_sweeps(answers, names).values()) == shown


def test_addresses_and_numbers_of_the_file():
    assert encode_query(clip="a b/c~d*e", mode="stream") == "clip=a+b%2Fc%7Ed*e&mode=stream"
    assert round_numbers({"a": [1.23456789, float("nan"), (float("inf"), 3, "x", None, True)]}) == {
        "a": [1.23457, None, [None, 3, "x", None, True]]
    }
