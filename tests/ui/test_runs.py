"""What the pages of runs are told."""

from __future__ import annotations

from typing import Any

from own_package import registers_kept

from memmlp.evaluation.units import HIGHER, UNITS
from memmlp.ui.runs import differing, units


def of(data: str, **config: Any) -> dict[str, Any]:
    return {"data": data, "config": config}


def test_one_folder_of_data_has_many_spellings():
    here, there = {"data.root": "data/mine", "seed": 0}, {"data.root": "/x/data/mine", "seed": 1}
    assert differing([of("d", **here), of("d", **there)]) == ["seed"]
    assert differing([of("d", **here), of("e", **there)]) == ["data.root", "seed"]
    assert differing([of("d", **here), of("d", seed=0)]) == []


def test_units_and_what_is_better_where_somebody_knows():
    names = ["MPJPE", "Jitter", "GT Jitter", "Score", "Odd"]
    metrics = [*(f"stream.rotation.{name}" for name in names), "window.rotation.MPJPE", "latency.median_ms"]
    with registers_kept():
        UNITS["Score"] = "points"
        HIGHER.add("Score")
        assert units(metrics) == {
            "MPJPE": {"unit": "cm", "better": "lower"},
            "Jitter": {"unit": "10² m/s³", "better": "lower"},
            "GT Jitter": {"unit": "10² m/s³", "better": ""},
            "Score": {"unit": "points", "better": "higher"},
            "median_ms": {"unit": "ms", "better": "lower"},
        }
    assert "Score" not in units(metrics)
