"""What loggers are shown follows from the folders alone."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_logger import a_run, an_outdated_evaluation

from memmlp.common.files import write_json
from memmlp.runs.identity import VERSIONS
from memmlp.runs.loggers.facts import Tail, read_run
from memmlp.runs.notes import add_tags, set_note


def test_status_is_that_of_the_folder(tmp_path: Path):
    run = a_run(tmp_path)
    assert read_run(run, running=True).status == "running"
    assert (read_run(run).status, read_run(run).ended) == ("killed", run.metrics()[-1].time)
    run.fail("a reason")
    assert (read_run(run).status, read_run(run).reason) == ("failed", "a reason")
    assert read_run(run, running=True).reason is None
    run.retry()
    run.finish([])
    assert read_run(run).status == "done"
    assert read_run(run, running=True).ended is None


def test_a_trained_run_without_what_was_asked_for_is_not_done(tmp_path: Path):
    run = a_run(tmp_path)
    run.want(["stream-0", "fp32-0"])
    run.finish([])
    assert read_run(run).status == "killed"
    run.evaluations.mkdir()
    write_json(run.evaluation("stream-0"), {"mode": "stream", "mean": {}, "clips": []})
    assert read_run(run).status == "killed"
    run.deployment("fp32-0").folder.mkdir(parents=True)
    run.deployment("fp32-0").finish({})
    assert read_run(run).status == "done"


def test_name_origin_data_labels_and_note(tmp_path: Path):
    run = a_run(tmp_path, data={"name": "mocap"}, memory={"layers": [2]})
    run.write_manifest({"name": "memory=gru · seed 1", "user": "somebody", "git": {"commit": "abc"}})
    add_tags(run, ["good"])
    set_note(run, "a note")
    facts = read_run(run)
    assert facts.name == "memory=gru · seed 1"
    assert facts.data == ("mocap", "d" * 64)
    assert (facts.tags, facts.note) == (("good",), "a note")
    assert (facts.origin["user"], facts.origin["commit"]) == ("somebody", "abc")
    assert facts.config["memory.layers"] == "[2]"


def test_results_by_an_earlier_recipe_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    run = a_run(tmp_path, evaluation={"ik": "off"})
    an_outdated_evaluation(run)
    monkeypatch.setitem(VERSIONS, "mode.stream", 0)
    now = read_run(run).fingerprint
    assert read_run(run).outdated == ""
    monkeypatch.setitem(VERSIONS, "mode.stream", 1)
    assert read_run(run).outdated == "stream (mode.stream 0 -> 1)"
    assert read_run(run).fingerprint != now


def test_a_tail_reads_the_last_of_repeated_steps_and_then_what_follows(tmp_path: Path):
    run = a_run(tmp_path)
    run.log(3, {"loss": 9.0})
    tail = Tail(run)
    assert [(p.step, p.value) for p in tail.read()] == [(1, 1.0), (2, 0.5), (3, 9.0)]
    assert tail.read() == []
    run.log(4, {"loss": 4.0})
    assert [(p.key, p.step) for p in tail.read()] == [("train/loss", 4)]
    assert not tail.repeated
    run.log(4, {"loss": 5.0})
    assert [p.value for p in tail.read()] == [5.0]
    assert tail.repeated


def test_a_line_is_read_when_it_is_whole(tmp_path: Path):
    run = a_run(tmp_path)
    tail = Tail(run)
    tail.read()
    whole = run.metrics_path.read_bytes().splitlines(keepends=True)[0]
    with open(run.metrics_path, "ab", buffering=0) as file:
        file.write(whole[:10])
        assert tail.read() == []
        file.write(whole[10:])
    assert [p.step for p in tail.read()] == [1]


def test_the_fingerprint_changes_with_all_that_is_shown(tmp_path: Path):
    run = a_run(tmp_path)
    seen = [read_run(run).fingerprint]
    for change in (
        lambda: run.log(4, {"loss": 1.0}),
        lambda: add_tags(run, ["a"]),
        lambda: write_json(run.results_path, {"a": 1.0}),
        lambda: run.fail("why"),
    ):
        change()
        seen.append(read_run(run).fingerprint)
    assert len(set(seen)) == len(seen)
    assert read_run(run).fingerprint == seen[-1]
