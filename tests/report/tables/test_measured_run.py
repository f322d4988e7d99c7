"""What a finished run has to say for tables."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from fake_runs import CLIPS, ORIGIN, fake_run, fake_sweep, table_of, write_evaluation
from fake_table import cell

from memmlp.common.errors import InputError
from memmlp.common.files import read_json
from memmlp.report.kept_results import KeptResults, format_results, load_kept_results
from memmlp.report.tables.measured_run import load_measured_run
from memmlp.report.tables.table_text import format_value
from memmlp.runs.evaluation_file import write_report
from memmlp.runs.run import Run
from memmlp.sweep.definition import Sweep


def test_size_and_times_are_of_the_precision_that_was_asked_for(sweep: Sweep, tmp_path: Path):
    run, part = fake_run(tmp_path, "run"), replace(sweep, seeds=(0,))
    path = run.deployment("fp32-0").latency
    int8 = {"onnx_bytes": 500_000, "median_ms": 0.4, "ratio_to_yardstick": 0.3, "pose_median_ms": 0.5}
    record = json.loads(path.read_text()) | {"pose_median_ms": 0.9, "alone_median_ms": 0.7, "int8": int8}

    def has_flag() -> bool:
        return any("less precision" in flag for flag in table_of(part, lambda *_: run).flags)

    path.write_text(json.dumps(record | {"settings": {"precision": "int8"}}))
    assert load_measured_run(run.folder).costs == pytest.approx({
        "FLOPs": 0.026, "MACs": 0.013, "parameters": 0.356798, "size": 0.5, "ms": 0.4, "network ms": 0.7,
        "pose ms": 0.5, "ratio": 0.3, "FPS": 2500,
    })  # fmt: skip
    assert has_flag()
    path.write_text(json.dumps(record))
    assert load_measured_run(run.folder).costs["size"] == 1.9
    assert not has_flag()


def test_what_an_evaluation_ran_on_counts_too(sweep: Sweep, tmp_path: Path):
    """An evaluation's numbers depend on code and device as the weights do."""
    other = {"device": "cuda:0", "made_by": {**ORIGIN, "git": {"commit": "fedcba98", "dirty": True}}}

    def run(variant, _: int) -> Run:
        return fake_run(tmp_path, variant.label, evaluated=other if variant.label == "by position" else None)

    said = " ".join(table_of(replace(sweep, seeds=(0,)), run).flags)
    for words in ("0123456, fedcba9 of", ", cuda:0 of", "uncommitted changes:"):
        assert f"{words} 'by position'" in said


def test_a_refined_network_saw_its_own_frames_and_the_refiners(tmp_path: Path):
    optim = {"steps": 10, "batch": 2}
    network = fake_run(tmp_path, "network", config={"optim": optim, "model": {"frames": 7}, "refiner": None})
    config = {"optim": {"steps": 5, "batch": 4}, "model": {"frames": 7}, "refiner": {"frames": 30}}
    refined = fake_run(tmp_path, "refined", config=config, origin={"prerequisite": network.id})
    seen = [load_measured_run(run.folder).training.get("frames") for run in (network, refined)]
    assert seen == [140, 140 + 600]
    orphan = fake_run(tmp_path, "orphan", config=config, origin={"prerequisite": "0" * 16})
    assert "frames" not in load_measured_run(orphan.folder).training  # what came before is not known


@pytest.mark.parametrize("keep", [False, True])
def test_results_without_their_digest_are_refused(tmp_path: Path, keep: bool):
    run = fake_run(tmp_path, "a")
    path = run.evaluation("stream-0")
    report = json.loads(path.read_text())
    report["mean"]["rotation"]["MPJPE"] = 1.0
    path.write_text(json.dumps({key: value for key, value in report.items() if keep or key != "digest"}))
    with pytest.raises(InputError, match=r"stream-0.json: .*changed .* digest"):
        load_measured_run(run.folder)


def test_results_of_another_run_are_refused(tmp_path: Path):
    path = (run := fake_run(tmp_path, "a")).evaluation("stream-0")
    write_evaluation(path, json.loads(path.read_text()) | {"run": "b" * 16})
    with pytest.raises(InputError, match="of another run"):
        load_measured_run(run.folder)


def test_clips_without_a_value_are_counted_at_the_number(tmp_path: Path, sweep: Sweep):
    find = fake_sweep(tmp_path, sweep)
    run = find(sweep.variants[3], 1)
    assert run is not None
    path = run.evaluation("stream-0")
    report = json.loads(path.read_text())
    for clip in report["clips"][:2]:
        clip["rotation"]["Jitter"] = "nan"
    write_evaluation(path, report)
    table = table_of(sweep, find)
    found = [cell(table, "full_model", metric) for metric in ("Jitter", "MPJPE")]
    assert [(one.counted, one.clips) for one in found] == [(10, 12), (12, 12)]
    assert [format_value(one, "Jitter").endswith("(10 of 12 clips)") for one in found] == [True, False]


@pytest.mark.parametrize("text", ["[{", "[5]", "{}"])
def test_damaged_results_are_one_line(tmp_path: Path, sweep: Sweep, text: str):
    find = fake_sweep(tmp_path, sweep)
    path = find(sweep.variants[3], 1).evaluation("stream-0")
    path.write_text(text)
    with pytest.raises(InputError, match=re.escape(str(path))):
        table_of(sweep, find)


def test_the_evaluations_of_a_table_are_its_own(tmp_path: Path):
    """Where a run has two evaluations of one mode, each table reads the one that it asks for."""
    run = fake_run(tmp_path, "a")
    report = json.loads(run.evaluation("stream-0").read_text())
    other = {"mode": "stream", "mean": {"combined": {"MPJPE": 1.0}}, "clips": report["clips"]}
    write_report(run.evaluation("stream-1"), other)
    assert load_measured_run(run.folder, ["stream-0"]).get_value("stream", "combined", "MPJPE") != 1.0
    assert load_measured_run(run.folder, ["stream-1"]).get_value("stream", "combined", "MPJPE") == 1.0
    assert load_measured_run(run.folder, ["stream-1"]).get_value("stream", "rotation", "MPJPE") is None


SOURCES = {clip: clip.split("/")[0] for clip in CLIPS}


def test_means_of_one_sources_clips(tmp_path):
    run = fake_run(tmp_path, "a")
    for path in run.evaluations.glob("*.json"):
        report = read_json(path)
        for row in report["clips"]:
            row["source"] = SOURCES[row["name"]]
        write_report(path, {key: value for key, value in report.items() if key != "digest"})
    measured = load_measured_run(run.folder)
    assert measured.clip_sources == SOURCES
    path = tmp_path / "kept.json"
    path.write_text(format_results(KeptResults("5", (), {"a": {0: measured}}, {"a": ()})))
    again = load_kept_results(path)
    assert again.sources == ("kicks", "salsa")
    assert format_results(again) == path.read_text()
    for run in (measured, again.runs["a"][0]):
        found = run.split_by_source()
        assert list(found) == ["kicks", "salsa"]
        assert list(found["kicks"].clips) == ["kicks/01", "kicks/02"]
        for source, part in found.items():
            own = [
                measured.clips[clip]["stream"]["rotation"]["MPJPE"]
                for clip in CLIPS
                if SOURCES[clip] == source
            ]
            mean = part.get_value("stream", "rotation", "MPJPE")
            assert mean == pytest.approx(sum(own) / len(own), rel=1e-4)
            assert mean != pytest.approx(measured.get_value("stream", "rotation", "MPJPE"), rel=1e-3)


@pytest.mark.parametrize(("shares", "counted"), [
    ([0.97, 0.5, None], [0]), ([0.7, 0.5, None], [0, 1, 2]), ([None, 0.97, 0.95], [1, 2]),
    ([0.95, 0.97, 0.9], [0, 1, 2]),
])  # fmt: skip
def test_times_are_of_undisturbed_seeds(sweep, tmp_path, shares: list[float | None], counted: list[int]):
    """Seed 0 took 1 ms, seed 1 took 3 ms, and so on; all other columns are of all seeds."""
    find = fake_sweep(tmp_path, sweep)
    for variant in sweep.list_runnable():
        for seed, share in enumerate(shares):
            path = find(variant, seed).deployment("fp32-0").latency
            known = {"median_ms": 1.0 + 2 * seed} | ({"core_share": share} if share is not None else {})
            path.write_text(json.dumps(json.loads(path.read_text()) | known))
    table = table_of(sweep, find)
    cells = table.rows[1].cells[table.modes[0]]
    assert (sorted(cells["ms"].values), sorted(cells["MPJPE"].values)) == (counted, [0, 1, 2])
    assert cells["ms"].mean == pytest.approx(sum(1.0 + 2 * seed for seed in counted) / len(counted))
    found = [flag.partition(": ")[2] for flag in table.flags if "core to themselves" in flag]
    each = ", ".join(f"'{variant.label}' ({len(counted)} of 3)" for variant in sweep.list_runnable())
    assert found == ([each] if len(counted) < 3 else [])
