"""What the page's one file keeps of a run."""

from __future__ import annotations

from typing import Any

from memmlp.report.ui.one_file import _run


def clip(name: str, error: Any) -> dict[str, Any]:
    """A clip's row, whose errors files hold as numbers or as words such as nan."""
    return {"name": name, "stream": {"rotation": {"MPJPE": error}}}


def test_clips_without_a_number_are_the_worst():
    clips = [clip("good", 3.0), clip("nan", "nan"), clip("bad", 9.0), {"name": "none"}, clip("inf", "inf")]
    kept = _run({"clips": clips, "manifest": {}})["clips"]
    assert [one["name"] for one in kept] == ["nan", "inf", "bad", "good", "none"]
