"""What the pages of runs are told."""

from __future__ import annotations

from typing import Any

from memmlp.ui.runs import differing


def of(data: str, **config: Any) -> dict[str, Any]:
    return {"data": data, "config": config}


def test_one_folder_of_data_has_many_spellings():
    here, there = {"data.root": "data/mine", "seed": 0}, {"data.root": "/x/data/mine", "seed": 1}
    assert differing([of("d", **here), of("d", **there)]) == ["seed"]
    assert differing([of("d", **here), of("e", **there)]) == ["data.root", "seed"]
    assert differing([of("d", **here), of("d", seed=0)]) == []
