"""What `memmlp train` says of a network's size and times."""

from __future__ import annotations

import io
import json
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
from fake_runs import fake_run
from rich.console import Console

from memmlp.cli.train_summary import show, show_latency, show_side_by_side, size, source_tables
from memmlp.runs.evaluation_file import write_report
from memmlp.training.request import Outcome

MEASURED = {"parameters": 19_238, "parameters_with_vqvae": 27_050, "macs": 218_048, "onnx_bytes": 995_047}


def test_a_small_network_has_operations_and_its_vqvae():
    both = "0.02 M parameters (0.03 M with parts that are frozen or for training alone), 0.218 MMAC a frame"
    assert size(MEASURED).startswith(both)


def test_a_network_without_a_vqvae_has_none():
    assert "frozen" not in size(MEASURED | {"parameters_with_vqvae": 19_238})


def test_tables_of_sources_are_of_the_evaluation_that_is_shown(tmp_path: Path):
    """A run was evaluated twice, the second time with three times the errors."""
    run = fake_run(tmp_path, "a", branches=("rotation",))
    report = json.loads(run.evaluation("stream-0").read_text())
    for clip in report["clips"]:
        clip["source"] = clip["name"].split("/")[0]
    write_report(run.evaluation("stream-0"), report)
    for clip in report["clips"]:
        clip["rotation"] = {metric: 3 * value for metric, value in clip["rotation"].items()}
    write_report(run.evaluation("stream-1"), report)

    def first(stage: str) -> list[float]:
        return [float(next(iter(table.columns[2].cells))) for table in source_tables(run, [stage])]

    assert len(first("stream-0")) == 2
    for once, thrice in zip(first("stream-0"), first("stream-1"), strict=True):
        assert abs(thrice - 3 * once) < 0.03


def test_brackets_in_a_folders_name_are_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run = fake_run(tmp_path / "[old]", "a")
    show(Outcome(run, (), {}, ()))
    assert f"run      {run.folder}\n" in capsys.readouterr().out


def test_a_network_that_hardly_saw_motion_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for steps, told in ((2000, False), (20, True)):
        config = {"optim": {"steps": steps, "batch": 8}, "model": {"frames": 11}}
        show(Outcome(fake_run(tmp_path, f"of {steps}", config=config), (), {}, ()))
        assert ("hardly trained" in capsys.readouterr().out) == told


def test_times_and_size_are_those_of_the_file_that_was_asked_for():
    times = {"median_ms": 3.39, "p95_ms": 3.5, "ratio_to_yardstick": 1.2, "settings": {"precision": "int8"}}
    record = MEASURED | times
    record["int8"] = {"median_ms": 1.27, "p95_ms": 1.4, "ratio_to_yardstick": 0.45, "onnx_bytes": 600_000}
    said = io.StringIO()
    show_latency(Console(file=said), record)
    first, last = said.getvalue().splitlines()
    assert first.startswith(
        "a frame on one CPU core in int8: 1.27 ms median, 1.40 ms p95 (0.45 x the yardstick, fp32 3.39 ms)"
    )
    assert "ONNX file 0.6 MB" in last
    assert "busy" not in said.getvalue()


@pytest.mark.parametrize("jitter", [0.05, 0.356])
def test_an_int8_file_that_is_not_used_live_is_told(jitter: float):
    times = {"median_ms": 3.39, "p95_ms": 3.5, "ratio_to_yardstick": 1.2, "onnx_bytes": 600_000}
    record = MEASURED | times | {"settings": {"precision": "int8"}}
    said = io.StringIO()
    cost = times | {"growth": 0.0016, "jitter_growth": jitter}
    show_latency(Console(file=said, width=200), record | {"int8": cost})
    line = "int8: MPJPE +0.2%, Jitter +35.6%, more than 1% and 10% allow: live use takes float32"
    assert (line in said.getvalue()) == (jitter > 0.1)


@pytest.mark.parametrize("key", ["core_share", "alone_core_share", "pose_core_share"])
def test_times_of_a_busy_machine_say_so(key: str):
    times = {"median_ms": 3.39, "p95_ms": 3.5, "ratio_to_yardstick": 1.2, key: 0.31}
    said = io.StringIO()
    show_latency(Console(file=said), MEASURED | times)
    assert "it had a core for 31% of the time" in said.getvalue()


def test_side_by_side_has_the_times_of_the_files_that_were_asked_for(capsys: pytest.CaptureFixture[str]):
    deployed = {"median_ms": 3.39, "settings": {"precision": "int8"}, "int8": {"median_ms": 1.27}}
    outcome = SimpleNamespace(
        results={"stream": {"rotation": {"MPJPE": 1.0}}, "latency": MEASURED | deployed}
    )
    show_side_by_side({"one": cast(Outcome, outcome)})
    assert "1.27" in capsys.readouterr().out


def test_side_by_side_shows_each_branch_that_differs(capsys: pytest.CaptureFixture[str]):
    """A network that predicts positions, too, is not compared by its rotations alone."""
    two = {"rotation": {"MPJRE": 2.0, "MPJPE": 6.49}, "position": {"MPJPE": 5.46}}
    one = {"rotation": {"MPJRE": 3.0, "MPJPE": 4.8}, "position": {"MPJPE": 4.8 * (1 + 1e-6)}}
    outcomes = {"two": {"stream": two}, "one": {"stream": one}}
    show_side_by_side({name: cast(Outcome, SimpleNamespace(results=own)) for name, own in outcomes.items()})
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["two", "two"] in lines
    assert ["metric", "unit", "rotation", "position", "one"] in lines
    assert ["MPJPE", "cm", "6.49", "5.46", "4.80"] in lines
    assert ["MPJRE", "deg", "2.00", "-", "3.00"] in lines
