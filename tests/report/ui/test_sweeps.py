"""Sweeps: how far they are, and the same verdicts as `memmlp table`."""

import json
import shlex
from dataclasses import replace
from pathlib import Path

import pytest
from fake_runs import fake_run
from report.ui.conftest import predict, run_of

from memmlp.cli.sweep import analyse
from memmlp.report.tables import build_table
from memmlp.report.tables.measured_run import load_measured_run
from memmlp.report.tables.seed_rounds import Rounds, start_rounds
from memmlp.report.tables.table_text import to_json
from memmlp.report.ui.run_index import RunIndex
from memmlp.report.ui.server import Answers
from memmlp.report.ui.sweeps import DAMAGED_ROUNDS, OTHER_ROUNDS, Sweeps
from memmlp.runs.run import Run
from memmlp.sweep.definition import Sweep, load_sweep_copy, save_sweep_copy
from memmlp.sweep.plan import Plan, RunTask


def sweeps_of(outputs: Path) -> Sweeps:
    index = RunIndex(outputs)
    index.refresh()
    sweeps = Sweeps(index)
    sweeps.refresh()
    return sweeps


def describe(sweeps: Sweeps) -> dict:
    sweeps.refresh()
    return sweeps.describe("mine")


def test_the_table_is_that_of_the_command(outputs: Path):
    sweep, plan = read_sweep(outputs)
    runs = build_table.find_finished_runs(sweep, build_table.make_run_finder(plan, load_measured_run))
    shown = describe(sweeps_of(outputs))["table"]
    assert shown["rows"] == json.loads(to_json(build_table.make_table(sweep, runs)))["rows"]
    cell = shown["rows"][1]["cells"]["stream"]["MPJPE"]
    assert (cell["effect"]["verdict"], cell["paper_effect"]) == ("holds", pytest.approx(-1.2))


def test_the_command_for_missing_runs_is_of_this_sweep(outputs: Path):
    sweep, _ = read_sweep(outputs)
    save_sweep_copy(replace(sweep, command_line=("memory.layers=[2]",)), outputs / "sweeps" / "mine")
    run_of(outputs, "gru", 2).marker.unlink()
    (flag,) = (flag for flag in describe(sweeps_of(outputs))["table"]["flags"] if "fill with" in flag)
    words = shlex.split(flag.partition("fill with: ")[2])
    expected = ["mine.yaml", "memory.layers=[2]", "seed=0,1,2", "--outputs", str(outputs)]
    assert words == ["memmlp", "sweep", *expected]


def test_progress_and_time_left(outputs: Path, monkeypatch: pytest.MonkeyPatch):
    before = describe(sweeps_of(outputs))
    assert (before["counts"], before["share"], before["remaining"]) == ({"done": 6}, 1.0, None)
    run = run_of(outputs, "gru", 2)
    run.marker.unlink()
    steps = range(0, 1001, 100)
    lines = [{"step": s, "phase": "train", "time": s / 100, "values": {"loss": 1}} for s in steps]
    run.metrics_path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    monkeypatch.setattr(Run, "activity", property(lambda self: None if self.done else "training"))
    sweeps = sweeps_of(outputs)
    found = describe(sweeps)
    assert found["counts"] == {"done": 5, "training": 1}
    assert found["share"] == pytest.approx(11 / 12)
    assert found["remaining"] is not None
    (cell,) = [cell for cell in describe(sweeps)["cells"] if cell["state"] == "training"]
    assert (cell["variant"], cell["seed"], cell["step"], cell["steps"]) == ("gru", 2, 1000, 2000)


def test_a_run_that_lacks_an_evaluation_is_trained_and_a_vqvae_is_a_prerequisite(outputs: Path):
    sweep, plan = read_sweep(outputs)
    first, *entries = plan.entries
    stages = {"stages": ("stream-absent",)}
    tasks = [replace(task, **stages) if task.id == first.id else task for task in plan.tasks]
    vqvae = RunTask(fake_run(outputs, "vqvae").id, "vqvae", {"vqvae": {"steps": 20}})
    plan = replace(plan, entries=(replace(first, **stages), *entries), tasks=(vqvae, *tasks))
    plan.save(outputs / "sweeps" / "mine" / "plan.json")
    found = describe(sweeps_of(outputs))
    assert (found["counts"], found["prerequisite_counts"]) == ({"trained": 1, "done": 5}, {"done": 1})
    assert found["tasks"] == 6
    tell, variant = build_table.make_state_finder(plan), sweep.list_runnable()[0]
    assert tell(variant, first.seed) == "trained, an evaluation or export is missing"
    plan.get_run(first).manifest_path.write_text("{")
    assert str(tell(variant, first.seed)).startswith("damaged: ")


def test_a_run_s_control_is_that_of_its_variant(outputs: Path):
    """Most of the paper's tables have a control that does not stand first."""
    answers = Answers(outputs, predict, 0.0)

    def control(variant: str) -> str | None:
        answers.next_look = 0.0
        found = answers.answer(f"run/{run_of(outputs, variant, 1).id}", {})["control"]
        return found and found["id"]

    assert (control("none"), control("gru")) == (None, run_of(outputs, "none", 1).id)
    save_sweep_copy(replace(read_sweep(outputs)[0], control="gru"), outputs / "sweeps" / "mine")
    assert (control("none"), control("gru")) == (run_of(outputs, "gru", 1).id, None)


def read_sweep(outputs: Path) -> tuple[Sweep, Plan]:
    folder = outputs / "sweeps" / "mine"
    sweep = load_sweep_copy(folder)
    assert sweep is not None
    return sweep, Plan.load(folder / "plan.json")


def looked(outputs: Path) -> Rounds:
    sweep, plan = read_sweep(outputs)
    return analyse(sweep, outputs, start_rounds(sweep), plan)


def test_verdicts_of_rounds_and_their_analyses_are_shown(outputs: Path):
    sweeps = sweeps_of(outputs)
    assert describe(sweeps)["rounds"] is None
    before = sweeps.refresh()
    rounds = looked(outputs)
    assert sweeps.refresh() != before
    page = describe(sweeps)
    effect = page["table"]["rows"][1]["cells"]["stream"]["MPJPE"]["effect"]
    assert (effect["verdict"], effect["decided"], effect["level"]) == ("holds", 3, rounds.levels[0])
    assert not {DAMAGED_ROUNDS, OTHER_ROUNDS} & set(page["table"]["flags"])
    first, second = page["rounds"]["analyses"][:2]
    assert first == {"seeds": 3, "level": rounds.levels[0], "compared": 2, "decided": 2}
    assert (second["compared"], page["rounds"]["comparisons"]) == (0, 2)
    variants = {one["label"]: one for one in page["rounds"]["variants"]}
    assert variants["gru"] == {"label": "gru", "decided": 2, "inconclusive": 0, "seeds": 3, "next": None}


@pytest.mark.parametrize(("change", "flag"), [
    ({"subject": {}}, OTHER_ROUNDS),
    ({"analyses": 3}, DAMAGED_ROUNDS),
    ({"analyses": [{"seeds": 3, "level": 0.1, "runs": {"gru": "0"}, "findings": []}]}, DAMAGED_ROUNDS),
])  # fmt: skip
def test_rounds_of_something_else_are_flagged(outputs: Path, change: dict, flag: str):
    looked(outputs)
    path = outputs / "sweeps" / "mine" / "rounds.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    page = describe(sweeps_of(outputs))
    assert page["rounds"] is None
    assert flag in page["table"]["flags"]
    assert page["table"]["rows"][1]["cells"]["stream"]["MPJPE"]["effect"]["decided"] is None


def test_damage_is_named(outputs: Path):
    for name, plan in (("bad", "{"), ("nofile", (outputs / "sweeps" / "mine" / "plan.json").read_text())):
        (outputs / "sweeps" / name).mkdir()
        (outputs / "sweeps" / name / "plan.json").write_text(plan)
    (run_of(outputs, "gru", 0).folder / "evaluations" / "stream-0.json").write_text("{")
    sweeps = sweeps_of(outputs)
    assert sorted(sweeps.list_rows()["damaged"]) == ["bad", "nofile"]
    assert any("cannot be read" in flag for flag in describe(sweeps)["table"]["flags"])
    with pytest.raises(KeyError):
        sweeps.describe("bad")
