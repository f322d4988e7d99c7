"""What the pages of runs are told."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from own_package import registers_kept

from memmlp.evaluation.metric_facts import HIGHER, UNITS
from memmlp.report.ui.runs import by_earlier_recipes, differing, partners, sets, shared, units
from memmlp.runs.evaluation_file import write_report
from memmlp.runs.identity import evaluation_id_of, evaluation_recipes, evaluation_settings
from memmlp.runs.recipe_versions import RECIPES
from memmlp.runs.run import Run


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


def network(run_id: str, data: str = "d", status: str = "done", **config: Any) -> dict[str, Any]:
    config = {"memory.name": "vq", "memory.codes": 8, "optim.lr": 1e-3, "seed": 0, **config}
    return {"id": run_id, "kind": "memmlp", "status": status, "data": data, "config": config}


def test_the_run_to_see_beside_one_is_of_its_data_and_differs_little():
    every = [
        network("own"),
        network("a_seed", seed=1),
        network("b_both", **{"memory.name": "none", "memory.codes": None, "optim.lr": 1e-2}),
        network("c_memory", **{"memory.name": "none", "memory.codes": None, "data.root": "/elsewhere"}),
        network("d_other_data", data="e"),
        network("e_trains", status="training"),
        network("f_rate", **{"optim.lr": 1e-2}),
    ]
    known = {run["id"]: run for run in every}
    assert partners(known, "own") == ["f_rate", "c_memory", "b_both", "a_seed"]
    assert partners(known, "own", control="b_both")[0] == "b_both"
    assert partners(known, "own", control="d_other_data")[0] == "f_rate"
    assert partners(known, "d_other_data") == []


def test_runs_of_different_data_that_share_a_name_are_told_apart():
    first, second = "78bb7c86", "877ca548"
    runs = [
        {"name": "tiny", "data": first, "data_name": "mocap"},
        {"name": "tiny", "data": second, "data_name": "synth"},
        {"name": "memory=none", "data": second, "data_name": "synth"},
        {"name": "VQ-VAE", "data": first, "data_name": ""},
        {"name": "damaged", "data": "", "data_name": ""},
    ]
    assert shared(runs) == ["tiny"]
    assert sets(runs) == {first: "mocap 78bb7c86", second: "synth 877ca548"}


def test_what_an_earlier_recipe_measured_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    run, settings = Run(tmp_path / ("a" * 16)), evaluation_settings({}, "window")
    report = {"mode": "window", "settings": settings, "recipes": evaluation_recipes(settings)}
    write_report(run.evaluation(evaluation_id_of(settings)), {**report, "mean": {}, "clips": []})
    assert by_earlier_recipes(run) == []
    now = RECIPES["mode.window"]
    monkeypatch.setitem(RECIPES, "mode.window", now + 1)
    assert by_earlier_recipes(run) == [f"window (mode.window {now} -> {now + 1})"]
    run.config_path.write_text("[")
    assert by_earlier_recipes(run) == []
