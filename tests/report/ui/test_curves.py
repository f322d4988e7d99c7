"""Curves are read as they grow, and thinned without losing their ends and peaks."""

from __future__ import annotations

from pathlib import Path

from report.ui.conftest import begun

from memmlp.report.ui.curves import Curves, thinned


def test_what_was_appended_is_added(tmp_path: Path):
    run = begun(tmp_path, step=200)
    curves = Curves(tmp_path)
    assert curves.of(run.id)["train loss"] == [[0, 100, 200], [5.0, 4.9, 4.8]]
    with open(run.metrics_path, "ab") as file:
        file.write(b'{"step": 300, "phase": "train", "time": 1, "values": {"loss": 1}}\n{"step": 400, "ph')
    read = curves.logs[run.id].read
    assert curves.of(run.id)["train loss"][0] == [0, 100, 200, 300]
    assert read < curves.logs[run.id].read < run.metrics_path.stat().st_size


def test_a_log_that_was_made_anew_is_read_anew(tmp_path: Path):
    run = begun(tmp_path, step=200)
    curves = Curves(tmp_path)
    curves.of(run.id)
    line = b'{"step": %d, "phase": "train", "time": 1, "values": {"loss": 2}}\n'
    run.metrics_path.write_bytes(b"".join(line % step for step in range(900)))
    assert curves.of(run.id)["train loss"][0][-1] == 899
    assert curves.of(run.id)["train loss"][1] == [2.0] * len(curves.of(run.id)["train loss"][0])


def test_names_pick_curves_and_a_step_done_twice_counts_once(tmp_path: Path):
    run = begun(tmp_path, step=100)
    run.log(100, {"loss": 9.0, "other": float("nan")})
    curves = Curves(tmp_path)
    assert curves.of(run.id, ["train loss", "no such"]) == {"train loss": [[0, 100], [5.0, 9.0]]}
    assert curves.of(run.id)["train other"] == [[100], [None]]
    assert curves.of("0" * 16) == {}


def test_thinning_keeps_ends_and_peaks():
    points = {step: 1.0 for step in range(10_000)} | {5_003: 9.0, 7_771: -3.0}
    steps, values = thinned(points, 100)
    assert (steps[0], steps[-1], max(values), min(values)) == (0, 9_999, 9.0, -3.0)
    assert len(steps) <= 110
    assert steps == sorted(steps)
