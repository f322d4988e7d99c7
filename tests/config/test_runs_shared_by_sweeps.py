"""Runs taken from other sweeps' kept results: the very same, and no others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from fake_runs import fake_sweep, runs_of

from memmlp.common.errors import InputError
from memmlp.config import runs_shared_by_sweeps
from memmlp.config.runs_shared_by_sweeps import with_kept
from memmlp.report.kept_results import Kept, overrides_of, save
from memmlp.sweep.definition import Sweep
from memmlp.sweep.plan import Entry, Plan
from memmlp.sweep.sweep_file import load_sweep
from memmlp.tables.effects import RunsBySeed

SWEEP = load_sweep(Path(__file__).parents[2] / "sweeps" / "table14.yaml")


@pytest.fixture
def runs(tmp_path: Path) -> dict[str, RunsBySeed]:
    return runs_of(SWEEP, fake_sweep(tmp_path / "runs", SWEEP))


@pytest.fixture
def file(runs: dict[str, RunsBySeed], tmp_path: Path) -> Path:
    save(tmp_path / "table14.json", Kept("table14", ("data=mocap",), runs, overrides_of(SWEEP)))
    return tmp_path / "table14.json"


def plan_today(monkeypatch: pytest.MonkeyPatch, runs: dict[str, RunsBySeed], **changed: str) -> None:
    """Plan Table 14 as the kept runs have it; `changed` gives the arm "2" other ids or stages."""
    entries = [
        Entry(label, seed, run.id, ("e1",)) for label, one in runs.items() for seed, run in one.items()
    ]
    planned = [
        replace(entry, id=changed.get("id", entry.id), stages=(changed.get("stage", "e1"),))
        if entry.label == "2"
        else entry
        for entry in entries
    ]
    monkeypatch.setattr("memmlp.config.runs_shared_by_sweeps.outdated", lambda recipes: [])
    monkeypatch.setattr(
        "memmlp.config.runs_shared_by_sweeps.plan_anew",
        lambda sweep, outputs: Plan(sweep.name, outputs, tuple(planned), ()),
    )


def wanted(runs: dict[str, RunsBySeed], label: str = "2") -> Plan:
    """The plan of another sweep, which wants the arm's runs under another name, one of them twice."""
    entries = [Entry("Mine", seed, run.id, ("e1",)) for seed, run in runs[label].items()]
    return Plan("mine", Path(), (*entries, replace(entries[0], label="Twin")), ())


def test_the_very_same_runs_are_taken(
    monkeypatch: pytest.MonkeyPatch, runs: dict[str, RunsBySeed], file: Path
):
    plan_today(monkeypatch, runs)
    found, files, *_ = with_kept({"Mine": {}, "Twin": {}}, wanted(runs), [file])
    assert {seed: run.id for seed, run in found["Mine"].items()} == {
        seed: run.id for seed, run in runs["2"].items()
    }
    assert [run.id for run in found["Twin"].values()] == [runs["2"][0].id]
    assert files == ("table14",)


def test_runs_of_the_outputs_stay(monkeypatch: pytest.MonkeyPatch, runs: dict[str, RunsBySeed], file: Path):
    plan_today(monkeypatch, runs)
    own = runs["2, 4"][0]
    found, *_ = with_kept({"Mine": {0: own}}, wanted(runs), [file])
    assert found["Mine"][0] is own
    assert sorted(found["Mine"]) == sorted(runs["2"])


def test_a_run_of_an_earlier_default_is_not_taken(
    monkeypatch: pytest.MonkeyPatch, runs: dict[str, RunsBySeed], file: Path
):
    """Both sweeps have another run there today, and it is the same one in both."""
    plan_today(monkeypatch, runs, id="f" * 16)
    other = runs["2, 4"][0].id
    entries = (Entry("Mine", 0, "f" * 16, ("e1",)), Entry("Other", 0, other, ("e1",)))
    found, *_ = with_kept({"Mine": {}, "Other": {}}, Plan("mine", Path(), entries, ()), [file])
    assert found["Mine"] == {}
    assert found["Other"][0].id == other


def test_another_evaluation_of_a_run_is_not_taken(
    monkeypatch: pytest.MonkeyPatch, runs: dict[str, RunsBySeed], file: Path
):
    plan_today(monkeypatch, runs, stage="e2")
    assert with_kept({"Mine": {}}, wanted(runs), [file]) == ({"Mine": {}}, (), (), ())


def test_a_file_without_such_runs_is_not_planned(
    monkeypatch: pytest.MonkeyPatch, runs: dict[str, RunsBySeed], file: Path
):
    def refused(*given: object) -> Plan:
        raise AssertionError("planned")

    monkeypatch.setattr("memmlp.config.runs_shared_by_sweeps.plan_anew", refused)
    plan = Plan("mine", Path(), (Entry("Mine", 0, "0" * 16, ("e1",)),), ())
    assert with_kept({"Mine": {}}, plan, [file]) == ({"Mine": {}}, (), (), ())


def test_a_run_of_an_earlier_recipe_is_not_taken(
    monkeypatch: pytest.MonkeyPatch, runs: dict[str, RunsBySeed], file: Path
):
    plan_today(monkeypatch, runs)
    monkeypatch.setattr("memmlp.config.runs_shared_by_sweeps.outdated", lambda recipes: ["metrics 1"])
    assert with_kept({"Mine": {}}, wanted(runs), [file]) == ({"Mine": {}}, (), (), ())


def test_a_file_that_cannot_be_planned_here_is_named_and_the_others_are_used(
    monkeypatch: pytest.MonkeyPatch, runs: dict[str, RunsBySeed], file: Path
):
    """Its data is on another machine, say."""
    plan_today(monkeypatch, runs)
    other = file.with_name("a.json")
    save(other, Kept("table04", ("data=mocap",), runs, {}))
    planned = runs_shared_by_sweeps.plan_anew

    def plan(sweep: Sweep, outputs: Path) -> Plan:
        if sweep.name == "table04":
            raise InputError("data.root=mine: allowed is an existing folder")
        return planned(sweep, outputs)

    monkeypatch.setattr("memmlp.config.runs_shared_by_sweeps.plan_anew", plan)
    found = with_kept({"Mine": {}}, wanted(runs), [other, file])
    assert found.files == ("table14",)
    assert sorted(found.runs["Mine"]) == sorted(runs["2"])
    assert "a.json: not used" in found.skipped[0]
    assert "data.root=mine" in found.skipped[0]


def test_seeds_that_were_spent_in_rounds_are_flagged(
    monkeypatch: pytest.MonkeyPatch, runs: dict[str, RunsBySeed], tmp_path: Path
):
    plan_today(monkeypatch, runs)
    kept = Kept("table14", ("data=mocap",), runs, overrides_of(SWEEP), rounds={"seeds": [0, 1, 2]})
    save(tmp_path / "rounds.json", kept)
    (flag,) = with_kept({"Mine": {}}, wanted(runs), [tmp_path / "rounds.json"]).flags
    assert flag.startswith("seeds of 'Mine', 'Twin' were spent in rounds of rounds")
