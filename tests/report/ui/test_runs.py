"""Rows of runs, units, curves."""

from pathlib import Path
from typing import Any

from own_package import registers_kept
from report.ui.conftest import started_run

from memmlp.evaluation.metric_facts import HIGHER, UNITS
from memmlp.report.ui.runs import (
    count_partial_clips,
    describe_units,
    find_differing_keys,
    read_curves,
    thin_out,
)
from memmlp.runs.run import Run


def of(data: str, **config: Any) -> dict[str, Any]:
    return {"data": data, "config": config}


def test_one_folder_of_data_has_many_spellings():
    here, there = {"data.root": "data/mine", "seed": 0}, {"data.root": "/x/data/mine", "seed": 1}
    assert find_differing_keys([of("d", **here), of("d", **there)]) == ["seed"]
    assert find_differing_keys([of("d", **here), of("e", **there)]) == ["data.root", "seed"]
    assert find_differing_keys([of("d", **here), of("d", seed=0)]) == []


def test_clips_without_a_value_are_counted():
    clips = [
        {"name": "a", "frames": 9, "stream": {"rotation": {"MPJPE": 1.0, "Jitter": value}}}
        for value in (2, None)
    ]
    assert count_partial_clips(clips) == {"stream.rotation.Jitter": [1, 2]}


def test_units_and_what_is_better_of_known_metrics():
    names = ["MPJPE", "Jitter", "GT Jitter", "Score", "Odd"]
    metrics = [*(f"stream.rotation.{name}" for name in names), "window.rotation.MPJPE", "latency.median_ms"]
    with registers_kept():
        UNITS["Score"] = "points"
        HIGHER.add("Score")
        assert describe_units(metrics) == {
            "MPJPE": {"unit": "cm", "better": "lower"}, "Jitter": {"unit": "10² m/s³", "better": "lower"},
            "GT Jitter": {"unit": "10² m/s³", "better": ""}, "Score": {"unit": "points", "better": "higher"},
            "median_ms": {"unit": "ms", "better": "lower"},
        }  # fmt: skip
    assert "Score" not in describe_units(metrics)


def test_curves_follow_a_log_that_is_being_written(tmp_path: Path):
    run = started_run(tmp_path, step=200)
    assert read_curves(run)["train loss"] == [[0, 100, 200], [5.0, 4.9, 4.8]]
    with open(run.metrics_path, "ab") as file:
        file.write(b'{"step": 300, "phase": "train", "time": 1, "values": {"loss": 1}}\n{"step": 400, "ph')
    assert read_curves(run)["train loss"][0] == [0, 100, 200, 300]
    line = b'{"step": %d, "phase": "train", "time": 1, "values": {"loss": 2}}\n'
    run.metrics_path.write_bytes(b"".join(line % step for step in range(900)))  # another log in its place
    steps, values = read_curves(run)["train loss"]
    assert (steps[-1], set(values)) == (899, {2.0})


def test_a_step_done_twice_counts_once(tmp_path: Path):
    run = started_run(tmp_path, step=100)
    run.log(100, {"loss": 9.0, "other": float("nan")})
    curves = read_curves(run)
    assert curves["train loss"] == [[0, 100], [5.0, 9.0]]
    assert curves["train other"] == [[100], [None]]
    assert read_curves(Run.from_id(tmp_path, "0" * 16)) == {}


def test_thinning_keeps_ends_and_peaks():
    points = {step: 1.0 for step in range(10_000)} | {5_003: 9.0, 7_771: -3.0}
    steps, values = thin_out(points, 100)
    assert (steps[0], steps[-1], max(values), min(values)) == (0, 9_999, 9.0, -3.0)
    assert len(steps) <= 110
    assert steps == sorted(steps)
