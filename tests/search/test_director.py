"""The study and its director: trials counted, pruned, failed and resumed, with runs written by the tests."""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml
from optuna.trial import TrialState

from memmlp.common.errors import InputError
from memmlp.runs.identity import run_id
from memmlp.runs.run import Run
from memmlp.search import results
from memmlp.search import study as study_module
from memmlp.search.board import figures
from memmlp.search.director import Director
from memmlp.search.spec import Search, Value, parse_search
from memmlp.search.study import Study, journal, mend
from memmlp.sweep.plan import Plan, RunTask

STEPS = 30
SPACE = {
    "rotation": {"low": 0.1, "high": 10.0, "log": True, "first": 1.0},
    "hand": {"low": 0.01, "high": 1.0, "log": True, "first": 0.1},
}


def search(**changes: Any) -> Search:
    content: dict[str, Any] = {
        "name": "mine", "base": ["loss=manual"], "space": {"loss": SPACE}, "objectives": ["MPJPE"],
        "n_trials": 6, "seeds": 1, "sampler": "tpe", "startup": 3, "seed": 0, "pruner": "none",
        "prune_after": 2, "storage": None,
    }  # fmt: skip
    return parse_search({**content, **changes})


def open_study(folder: Path, **changes: Any) -> Study:
    return Study.own(search(**changes), "mine", folder)


def compose(values: Mapping[str, Value], seeds: int = 1) -> list[list[RunTask]]:
    configs = [{"optim": {"steps": STEPS}, "values": dict(values), "seed": seed} for seed in range(seeds)]
    return [
        [RunTask(run_id("memmlp", config, data="d", upstream=None), "memmlp", config)] for config in configs
    ]


def director(study: Study, folder: Path, composed: Callable = compose) -> Director:
    return Director(study, composed, Plan("mine", folder, (), (), open=True))


def error(config: Mapping[str, Any]) -> float:
    """Return a trial's error: lowest at weights of 2 and 0.2, and 0.3 higher with each further seed."""
    values = config["values"]
    return 5 + abs(values["loss.rotation"] - 2) + abs(values["loss.hand"] - 0.2) + 0.3 * config["seed"]


def log(run: Run, step: int, value: float) -> None:
    run.log(step, {"rotation MPJPE": value, "rotation Jitter": 20 - value}, "val")


def finish(plan: Plan) -> None:
    """Bring the runs of a plan to their end."""
    for task in plan.left():
        run = plan.run_of(task)
        run.begin("memmlp", task.config, data="d", upstream=None)
        log(run, STEPS, error(task.config))
        run.finish([])


def to_the_end(study: Study, folder: Path, capacity: int = 2) -> None:
    one = director(study, folder)
    while (plan := one.look(capacity)).tasks:
        finish(plan)


def test_a_search_has_the_trials_it_wants_and_the_papers_first(tmp_path: Path):
    study = open_study(tmp_path)
    to_the_end(study, tmp_path)
    assert [trial.state for trial in study.trials] == [TrialState.COMPLETE] * 6
    assert study.trials[0].params == {"loss.rotation": 1.0, "loss.hand": 0.1}
    assert len({run for trial in study.trials for run in trial.user_attrs["runs"]}) == 6
    for trial in study.trials:
        assert trial.value == pytest.approx(error({"values": trial.params, "seed": 0}))
    assert study.best()[0].value == min(trial.value for trial in study.trials)


def test_the_number_of_trials_is_a_total(tmp_path: Path):
    to_the_end(open_study(tmp_path), tmp_path)
    again = open_study(tmp_path)
    assert director(again, tmp_path).look(2).tasks == ()
    more = open_study(tmp_path, n_trials=8)
    to_the_end(more, tmp_path)
    assert len(more.trials) == 8


def test_capacity_is_kept_and_each_plan_holds_what_is_under_way(tmp_path: Path):
    one = director(open_study(tmp_path), tmp_path)
    assert len(one.look(3).tasks) == 3
    assert one.look(3) == one.look(3)
    finish(one.look(3))
    plan = one.look(3)
    assert [entry.label for entry in plan.entries] == ["trial 3", "trial 4", "trial 5"]
    assert plan.open


@pytest.mark.parametrize("moment", range(4))
def test_a_director_killed_while_it_asks_loses_and_repeats_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: int
):
    """It dies before a new trial's first value, between its values, after them, or once its run is known."""
    study = open_study(tmp_path)
    one = director(study, tmp_path)
    finish(one.look(1))
    before = [trial.number for trial in study.trials]

    calls = 0
    whole = study_module.suggest

    def killed(*arguments: Any) -> Value:
        nonlocal calls
        if calls == moment:
            raise KeyboardInterrupt
        calls += 1
        return whole(*arguments)

    def composed(values: Mapping[str, Value]) -> list[list[RunTask]]:
        if moment == 2:
            raise KeyboardInterrupt
        return compose(values)

    with monkeypatch.context() as patch:
        patch.setattr(study_module, "suggest", killed)
        one.compose = composed
        if moment < 3:
            with pytest.raises(KeyboardInterrupt):
                one.look(1)
        else:
            one.look(1)
    study = open_study(tmp_path)
    assert [trial.number for trial in study.trials] == [*before, 1]
    to_the_end(study, tmp_path)
    assert [trial.number for trial in study.trials] == list(range(6))
    assert all(trial.state == TrialState.COMPLETE for trial in study.trials)
    assert all(set(trial.params) == {"loss.rotation", "loss.hand"} for trial in study.trials)
    assert len({tuple(trial.params.values()) for trial in study.trials}) == 6


def test_a_resumed_search_proposes_what_the_undisturbed_one_does(tmp_path: Path):
    calm = open_study(tmp_path / "calm" if (tmp_path / "calm").mkdir() is None else tmp_path)
    to_the_end(calm, tmp_path / "calm", capacity=1)
    (tmp_path / "stopped").mkdir()
    for _ in range(6):
        one = director(open_study(tmp_path / "stopped"), tmp_path / "stopped")
        finish(one.look(1))
    last = open_study(tmp_path / "stopped")
    to_the_end(last, tmp_path / "stopped", capacity=1)
    assert [trial.params for trial in last.trials] == [trial.params for trial in calm.trials]


def test_the_seed_changes_what_is_proposed_and_the_sampler_too(tmp_path: Path):
    proposed = []
    for name, changes in {"a": {}, "b": {"seed": 1}, "c": {"sampler": "random"}}.items():
        (tmp_path / name).mkdir()
        study = open_study(tmp_path / name, **changes)
        to_the_end(study, tmp_path / name, capacity=1)
        proposed.append([tuple(trial.params.values()) for trial in study.trials])
    assert proposed[0] != proposed[1]
    assert proposed[0] != proposed[2]


def test_a_torn_line_and_a_dead_owners_lock_are_mended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """At once: Optuna alone sleeps until the lock is half a minute old."""

    def sleep(seconds: float) -> None:
        raise AssertionError("it waits for the lock")

    study = open_study(tmp_path)
    one = director(study, tmp_path)
    finish(one.look(2))
    one.look(2)
    with open(journal(tmp_path), "ab") as file:
        file.write(b'{"op_code":4,"worker_id":"x"')
    Path(f"{journal(tmp_path)}.lock").symlink_to(journal(tmp_path))
    monkeypatch.setattr("memmlp.runs.run.changes", str)  # git, in a changed checkout, is waited for in sleeps
    monkeypatch.setattr(time, "sleep", sleep)
    to_the_end(open_study(tmp_path), tmp_path)
    again = open_study(tmp_path)
    assert [trial.number for trial in again.trials] == list(range(6))


def test_mending_leaves_a_whole_journal_alone(tmp_path: Path):
    open_study(tmp_path)
    content = journal(tmp_path).read_bytes()
    mend(journal(tmp_path))
    assert journal(tmp_path).read_bytes() == content
    mend(tmp_path / "none.journal")
    assert not (tmp_path / "none.journal").exists()


def begun(plan: Plan) -> Run:
    """Begin the run of a plan's only task, and return it."""
    (task,) = plan.tasks
    run = plan.run_of(task)
    run.begin("memmlp", task.config, data="d", upstream=None)
    return run


def test_a_trial_worse_than_the_median_is_pruned_and_its_run_cancelled(tmp_path: Path):
    study = open_study(tmp_path, pruner="median", prune_after=2)
    one = director(study, tmp_path)
    for level in (5.0, 6.0):
        run = begun(one.look(1))
        for step in (10, 20, 30):
            log(run, step, level)
        run.finish([])
    run = begun(one.look(1))
    log(run, 10, 5.2)
    assert run.id in {task.id for task in one.look(1).tasks}  # better than the median of 5 and 6
    run.fail("not of interest here")
    failed = run.id
    run = begun(one.look(1))
    log(run, 10, 7.0)
    plan = one.look(1)
    assert set(plan.cancelled) == {run.id, failed}
    assert run.id not in {task.id for task in plan.tasks}
    assert [trial.state for trial in study.trials[:4]] == [
        *[TrialState.COMPLETE] * 2,
        TrialState.FAIL,
        TrialState.PRUNED,
    ]
    assert study.trials[0].intermediate_values == {10: 5.0, 20: 5.0, 30: 5.0}
    resumed = director(open_study(tmp_path, pruner="median", prune_after=2), tmp_path)
    assert set(resumed.look(1).cancelled) == {run.id, failed}


def test_no_trial_is_pruned_at_its_last_step_or_without_a_pruner(tmp_path: Path):
    for name, pruner, step in (("last", "median", STEPS), ("none", "none", 10)):
        (tmp_path / name).mkdir()
        study = open_study(tmp_path / name, pruner=pruner, prune_after=1)
        one = director(study, tmp_path / name)
        for level in (5.0, 6.0):
            run = begun(one.look(1))
            log(run, step, level)
            if step < STEPS:
                log(run, STEPS, level)
            run.finish([])
        log(begun(one.look(1)), step, 50.0)
        assert one.look(1).cancelled == ()


def test_a_failed_run_fails_its_trial_and_the_search_goes_on(tmp_path: Path):
    study = open_study(tmp_path)
    one = director(study, tmp_path)
    begun(one.look(1)).fail("the loss is nan")
    to_the_end(study, tmp_path)
    assert study.trials[0].state == TrialState.FAIL
    assert study.trials[0].user_attrs["reason"] == "the loss is nan"
    assert [trial.state for trial in study.trials[1:]] == [TrialState.COMPLETE] * 5


def test_values_that_make_no_sense_fail_their_trial_and_hopeless_searches_end(tmp_path: Path):
    def refused(values: Mapping[str, Value]) -> list[list[RunTask]]:
        raise InputError("hand=position needs positions")

    study = open_study(tmp_path, n_trials=20)
    one = director(study, tmp_path, refused)
    with pytest.raises(InputError, match="all 5 trials failed, the last one so: hand=position needs"):
        one.look(2)


def test_a_value_that_is_no_number_is_a_failure(tmp_path: Path):
    study = open_study(tmp_path)
    one = director(study, tmp_path)
    run = begun(one.look(1))
    log(run, STEPS, float("nan"))
    run.finish([])
    one.look(1)
    assert study.trials[0].state == TrialState.FAIL


def test_a_pruned_trials_run_is_wanted_again_by_one_with_its_values(tmp_path: Path):
    space = {"hand": {"choices": ["off", "fk"]}}
    study = open_study(tmp_path, space=space, pruner="median", prune_after=1, n_trials=12)
    one = director(study, tmp_path)
    seen = set()
    for _ in range(12):
        plan = one.look(1)
        if not plan.tasks:
            break
        assert not {task.id for task in plan.tasks} & set(plan.cancelled)
        (task,) = plan.tasks
        seen.add(task.id)
        run = plan.run_of(task)
        if not run.done:
            run.begin("memmlp", task.config, data="d", upstream=None)
            log(run, 10, 5.0 if not seen - {task.id} else 9.0)
            one.look(1)
            if study.trials[-1].state != TrialState.PRUNED and not run.done:
                log(run, STEPS, 5.0)
                run.finish([])
    assert all(trial.state.is_finished() for trial in study.trials[:-1])


def seeded(study: Study, folder: Path) -> Director:
    return director(study, folder, partial(compose, seeds=study.search.seeds))


def test_a_trials_value_is_the_mean_of_its_seeds(tmp_path: Path):
    study = open_study(tmp_path, seeds=3, n_trials=2)
    one = seeded(study, tmp_path)
    while (plan := one.look(1)).tasks:
        finish(plan)
    for trial in study.trials:
        first = error({"values": trial.params, "seed": 0})
        assert trial.value == pytest.approx(first + 0.3)
        assert [value for (value,) in trial.user_attrs["values"]] == pytest.approx(
            [first, first + 0.3, first + 0.6]
        )
        assert figures(trial) == f"{trial.value:.3f} ± 0.300"
        assert len(set(trial.user_attrs["runs"])) == 3


def test_the_other_seeds_wait_for_the_first_ones_end_and_count_for_capacity(tmp_path: Path):
    one = seeded(open_study(tmp_path, seeds=3), tmp_path)
    plan = one.look(2)
    assert [(entry.label, entry.seed) for entry in plan.entries] == [("trial 0", 0), ("trial 1", 0)]
    run = begun(replace(plan, tasks=plan.tasks[:1]))
    log(run, STEPS, 5.0)
    run.finish([])
    plan = one.look(2)
    assert [(entry.label, entry.seed) for entry in plan.entries] == [
        ("trial 0", 0), ("trial 0", 1), ("trial 0", 2), ("trial 1", 0),
    ]  # fmt: skip
    assert len(plan.left()) == 3
    assert one.look(4).entries[-1].label == "trial 2"


def test_pruning_is_by_the_first_seed_alone(tmp_path: Path):
    study = open_study(tmp_path, seeds=2, pruner="median", prune_after=1)
    one = seeded(study, tmp_path)
    for level in (5.0, 6.0):
        for _ in range(2):
            run = begun(replace(plan := one.look(1), tasks=tuple(plan.left())))
            for step in (10, 20, STEPS):
                log(run, step, level)
            run.finish([])
    run = begun(one.look(1))
    log(run, 10, 50.0)
    run.finish([])  # done before the director looks, so that it is not pruned
    second = begun(replace(plan := one.look(1), tasks=tuple(plan.left())))
    log(second, 20, 50.0)  # a further bad seed enters the mean, but doesn't end the trial
    assert second.id in {task.id for task in one.look(1).left()}
    assert study.trials[2].intermediate_values == {10: 50.0}
    second.fail("not of interest here")
    run = begun(one.look(1))
    log(run, 10, 50.0)
    plan = one.look(1)
    assert run.id in plan.cancelled
    assert study.trials[-2].state == TrialState.PRUNED
    assert study.trials[-2].user_attrs["runs"] == [run.id]


def test_one_failed_seed_fails_the_trial_and_cancels_the_others(tmp_path: Path):
    study = open_study(tmp_path, seeds=3)
    one = seeded(study, tmp_path)
    finish(one.look(1))
    plan = one.look(1)
    bad, other = (begun(replace(plan, tasks=(task,))) for task in plan.left())
    bad.fail("the loss is nan")
    plan = one.look(1)
    assert study.trials[0].state == TrialState.FAIL
    assert study.trials[0].user_attrs["reason"] == "the loss is nan"
    assert {bad.id, other.id} <= set(plan.cancelled)
    assert other.id not in {task.id for task in plan.tasks}


def test_a_director_killed_between_seeds_repeats_and_loses_none(tmp_path: Path):
    (tmp_path / "calm").mkdir()
    calm = open_study(tmp_path / "calm", seeds=3, n_trials=3)
    one = seeded(calm, tmp_path / "calm")
    while (plan := one.look(1)).tasks:
        finish(plan)
    stopped = open_study(tmp_path, seeds=3, n_trials=3)
    made: list[str] = []
    while tasks := (plan := seeded(stopped, tmp_path).look(1)).left():  # a director of its own for each run
        made.append(tasks[0].id)
        finish(replace(plan, tasks=tasks[:1]))
        stopped = open_study(tmp_path, seeds=3, n_trials=3)
    assert len(made) == len(set(made)) == 9
    assert [trial.values for trial in stopped.trials] == [trial.values for trial in calm.trials]
    assert [trial.user_attrs["runs"] for trial in stopped.trials] == [
        trial.user_attrs["runs"] for trial in calm.trials
    ]


def test_trials_of_several_seeds_as_csv(tmp_path: Path):
    study = open_study(tmp_path, seeds=2, n_trials=2, objectives=["MPJPE", "Jitter"])
    one = seeded(study, tmp_path)
    finish(one.look(1))
    finish(one.look(1))
    begun(one.look(1)).fail("the loss is nan")
    one.look(1)
    results.write_trials(study, tmp_path / "trials.csv")
    with open(tmp_path / "trials.csv", newline="") as file:
        row, failed = csv.DictReader(file)
    first = error({"values": study.trials[0].params, "seed": 0})
    assert float(row["MPJPE"]) == pytest.approx(first + 0.15)
    assert float(row["MPJPE sd"]) == pytest.approx(0.3 / 2**0.5)
    assert float(row["MPJPE, run 1"]) == pytest.approx(first)
    assert float(row["Jitter, run 2"]) == pytest.approx(20 - first - 0.3)
    assert len(row["run"].split()) == 2
    assert (failed["state"], failed["MPJPE sd"], failed["reason"]) == ("fail", "", "the loss is nan")
    (path,) = results.write_experiments(study, tmp_path, ["loss"])
    assert row["run"] in path.read_text()


def test_two_objectives_give_a_front(tmp_path: Path):
    study = open_study(tmp_path, objectives=["MPJPE", "Jitter"])
    to_the_end(study, tmp_path)
    front = study.best()
    assert len(front) == 6  # Jitter is 20 less MPJPE here, so that none is better in both
    assert [trial.values[0] for trial in front] == sorted(trial.values[0] for trial in front)
    files = results.write_experiments(study, tmp_path, ["loss"])
    assert [file.name for file in files] == ["best.yaml", *(f"trial-{t.number}.yaml" for t in front[1:])]
    names = {path.name for path in results.write_plots(study, tmp_path)}
    assert names == {"pareto_front.png", "parallel_coordinate.png", "slice.png", "study.html"}


@pytest.mark.slow
def test_what_a_search_leaves(tmp_path: Path):
    study = open_study(tmp_path)
    to_the_end(study, tmp_path)
    results.write_trials(study, tmp_path / "trials.csv")
    with open(tmp_path / "trials.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["trial"] for row in rows] == list("012345")
    assert [float(row["MPJPE"]) for row in rows] == [trial.value for trial in study.trials]
    (path,) = results.write_experiments(study, tmp_path, ["loss"])
    best = study.best()[0]
    content = yaml.safe_load(path.read_text())
    assert content["defaults"] == [{"override /loss": "manual"}, "_self_"]
    assert {f"loss.{key}": value for key, value in content["loss"].items()} == best.params
    assert path.read_text().startswith("# @package _global_\n")
    shipped = tmp_path / "shipped.yaml"
    shipped.write_text("control: b\narms: {a: {overrides: [loss=manual]}, b: []}\n")
    assert results.write_table(study, shipped, tmp_path / "table05.yaml")
    arms = yaml.safe_load((tmp_path / "table05.yaml").read_text())["arms"]
    assert list(arms) == ["manual, searched", "a", "b"]
    assert f"loss.hand={best.params['loss.hand']}" in arms["manual, searched"]["overrides"]
    written = results.write_plots(study, tmp_path)
    assert {path.name for path in written} == {
        "optimization_history.png", "parallel_coordinate.png", "slice.png", "param_importances.png",
        "study.html",
    }  # fmt: skip
    assert all(path.stat().st_size > 5000 for path in written)
    page = (tmp_path / "study.html").read_text()
    assert "<script src=" not in page


def test_table_5_takes_only_loss_weights(tmp_path: Path):
    study = open_study(tmp_path, space={"optim": {"lr": {"low": 0.1, "high": 1.0}}}, n_trials=1)
    one = director(study, tmp_path)
    run = begun(one.look(1))
    log(run, STEPS, 1.0)
    run.finish([])
    one.look(1)
    assert not results.write_table(study, tmp_path / "none", tmp_path / "table05.yaml")


def test_a_study_is_looked_at_while_its_owner_works(tmp_path: Path):
    assert Study.view(search(), "mine", tmp_path) is None
    study = open_study(tmp_path)
    director(study, tmp_path).look(2)
    seen = Study.view(search(), "mine", tmp_path)
    assert seen is not None
    assert len(seen.trials) == 2
    assert Study.view(search(), "other", tmp_path) is None


def test_a_team_storage_and_a_bad_one(tmp_path: Path):
    study = open_study(tmp_path, storage=f"sqlite:///{tmp_path}/team.db")
    to_the_end(study, tmp_path)
    assert len(study.trials) == 6
    assert not journal(tmp_path).exists()
    with pytest.raises(InputError, match=r"search\.storage=nonsense:"):
        open_study(tmp_path, storage="nonsense://x")


def test_a_best_trial_of_groups_lists_and_plain_keys_is_a_config(tmp_path: Path):
    space = {"hand": {"choices": ["off", "fk"]}, "memory": {"layers": {"choices": [[2], [2, 4]]}}}
    space |= {"seed": {"low": 3, "high": 9}}
    study = open_study(tmp_path, space=space, n_trials=1, base=[])
    one = director(study, tmp_path)
    run = begun(one.look(1))
    log(run, STEPS, 1.0)
    run.finish([])
    one.look(1)
    (path,) = results.write_experiments(study, tmp_path, ["hand", "memory"])
    content = yaml.safe_load(path.read_text())
    assert content["defaults"][0]["override /hand"] in ("off", "fk")
    assert content["memory"]["layers"] in ([2], [2, 4])
    assert content["seed"] in range(3, 10)


@pytest.mark.parametrize(
    "content", [b"x" * 5000, b"hello\nthis is no journal\n", b'{"op_code":0,"x":1}\ngarbage\n{}\n']
)
def test_what_is_no_journal_is_left_alone_and_named(tmp_path: Path, content: bytes):
    journal(tmp_path).write_bytes(content)
    for look in (open_study, lambda folder: Study.view(search(), "mine", folder)):
        with pytest.raises(InputError, match=r"study.journal: not a journal of Optuna's"):
            look(tmp_path)
    assert journal(tmp_path).read_bytes() == content


def test_validations_of_a_network_used_otherwise_are_no_trials(tmp_path: Path):
    """The blend acts when the network is used: the run is the same, what it logged is not."""

    def blended(value: float) -> Callable:
        def composed(values: Mapping[str, Value]) -> list[list[RunTask]]:
            ((task,),) = compose(values)
            return [[replace(task, config={**task.config, "memory": {"blend": value}})]]

        return composed

    for value, state in ((0.5, "COMPLETE"), (0.1, "FAIL")):
        folder = tmp_path / f"blend {value}"
        folder.mkdir()
        study = Study.own(search(n_trials=1), folder.name, folder)
        one = director(study, tmp_path, blended(value))
        while (plan := one.look(1)).tasks:
            finish(plan)
        (trial,) = study.trials
        assert trial.state.name == state
    assert "was validated with {'memory.blend': 0.5}, not {'memory.blend': 0.1}" in trial.user_attrs["reason"]
