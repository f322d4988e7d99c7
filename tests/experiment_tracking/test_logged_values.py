"""What loggers are shown follows from the folders alone."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_logger import a_run, an_outdated_evaluation

from memmlp.common.files import write_json
from memmlp.experiment_tracking.logged_values import SYSTEM, SweepFacts, Tail, facts_of, final, fingerprint
from memmlp.runs.metrics_log import MetricsLog
from memmlp.runs.notes import add_tags, set_note
from memmlp.runs.recipe_versions import RECIPES


def test_status_is_that_of_the_folder(tmp_path: Path):
    run = a_run(tmp_path)
    assert facts_of(run, running=True).status == "running"
    assert facts_of(run).status == "killed"
    run.fail("a reason")
    assert (facts_of(run).status, facts_of(run).reason) == ("failed", "a reason")
    assert facts_of(run, running=True).reason is None
    run.retry()
    run.finish([])
    assert facts_of(run).status == "done"
    assert facts_of(run, running=True).ended is None


def test_a_trained_run_without_what_was_asked_for_is_not_done(tmp_path: Path):
    run = a_run(tmp_path)
    run.want(["stream-0", "fp32-0"])
    run.finish([])
    assert facts_of(run).status == "killed"
    run.evaluations.mkdir()
    write_json(run.evaluation("stream-0"), {"mode": "stream", "mean": {}, "clips": []})
    assert facts_of(run).status == "killed"
    run.deployment("fp32-0").folder.mkdir(parents=True)
    run.deployment("fp32-0").finish({})
    assert facts_of(run).status == "done"


def test_a_run_that_nobody_finished_ended_with_its_last_line(tmp_path: Path):
    run = a_run(tmp_path)
    assert facts_of(run).ended == run.metrics()[-1].time


def test_name_origin_data_labels_and_note(tmp_path: Path):
    run = a_run(tmp_path, data={"name": "mocap"}, memory={"layers": [2]})
    run.write_manifest({"name": "memory=gru · seed 1", "user": "somebody", "git": {"commit": "abc"}})
    add_tags(run, ["good"])
    set_note(run, "a note")
    facts = facts_of(run)
    assert (facts.name, facts.title) == ("memory=gru · seed 1", "memory=gru · seed 1 · 00000000")
    assert facts.data == ("mocap", "d" * 64)
    assert (facts.tags, facts.note) == (("good",), "a note")
    assert (facts.origin["user"], facts.origin["commit"]) == ("somebody", "abc")
    assert facts.config["memory.layers"] == "[2]"


def test_results_by_an_earlier_recipe_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    run = a_run(tmp_path, evaluation={"ik": "off"})
    an_outdated_evaluation(run)
    monkeypatch.setitem(RECIPES, "mode.stream", 0)
    now = fingerprint(run, facts_of(run))
    assert facts_of(run).earlier == ""
    monkeypatch.setitem(RECIPES, "mode.stream", 1)
    assert facts_of(run).earlier == "stream (mode.stream 0 -> 1)"
    assert fingerprint(run, facts_of(run)) != now


def test_results_lie_at_the_last_step(tmp_path: Path):
    run = a_run(tmp_path)
    write_json(run.results_path, {"stream": {"rotation": {"MPJPE": 6.5}}, "words": "text", "yes": True})
    assert [(p.key, p.value, p.step) for p in final(facts_of(run), 3)] == [("stream/rotation/MPJPE", 6.5, 3)]


def test_history_has_the_last_of_repeated_steps_and_the_tail_what_follows(tmp_path: Path):
    run = a_run(tmp_path)
    run.log(3, {"loss": 9.0})
    tail = Tail(run)
    assert [(p.step, p.value) for p in tail.history()] == [(1, 1.0), (2, 0.5), (3, 9.0)]
    assert tail.read() == []
    run.log(4, {"loss": 4.0})
    MetricsLog(run.folder / SYSTEM).append(0, {"cpu_percent": 50.0}, "system")
    assert [(p.key, p.step) for p in tail.read()] == [("train/loss", 4), ("system/cpu_percent", 0)]


def test_a_line_is_read_when_it_is_whole(tmp_path: Path):
    run = a_run(tmp_path)
    tail = Tail(run)
    tail.history()
    whole = run.metrics_path.read_bytes().splitlines(keepends=True)[0]
    with open(run.metrics_path, "ab", buffering=0) as file:
        file.write(whole[:10])
        assert tail.read() == []
        file.write(whole[10:])
    assert [p.step for p in tail.read()] == [1]


def test_a_tail_reads_a_bounded_number_of_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Tail, "MOST", 2)
    run, tail = a_run(tmp_path, steps=5), None
    tail = Tail(run)
    assert [[p.step for p in tail.read()] for _ in range(4)] == [[1, 2], [3, 4], [5], []]


def test_the_fingerprint_changes_with_all_that_is_shown(tmp_path: Path):
    run = a_run(tmp_path)
    seen = [fingerprint(run, facts_of(run))]
    for change in (
        lambda: run.log(4, {"loss": 1.0}),
        lambda: add_tags(run, ["a"]),
        lambda: write_json(run.results_path, {"a": 1.0}),
        lambda: MetricsLog(run.folder / SYSTEM).append(0, {"a": 1.0}, "system"),
        lambda: run.fail("why"),
    ):
        change()
        seen.append(fingerprint(run, facts_of(run)))
    assert len(set(seen)) == len(seen)
    assert fingerprint(run, facts_of(run)) == seen[-1]


def test_a_sweep_without_a_whole_summary_has_no_facts(tmp_path: Path):
    assert SweepFacts.read(tmp_path) is None
    write_json(tmp_path / "summary.json", {"name": "mine"})
    assert SweepFacts.read(tmp_path) is None
