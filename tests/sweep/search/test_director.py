"""The director: trials counted, pruned, failed and resumed, with runs written by the tests."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import fake_search
import pytest
from optuna.trial import TrialState

from memmlp.common.errors import InputError
from memmlp.sweep.plan import RunTask
from memmlp.sweep.search import study as study_module
from memmlp.sweep.search.search_file import Value


def test_a_search_has_the_trials_it_wants_and_the_papers_first(tmp_path: Path):
    study = fake_search.open_study(tmp_path)
    fake_search.to_the_end(study, tmp_path)
    assert [trial.state for trial in study.trials] == [TrialState.COMPLETE] * 6
    assert study.trials[0].params == {"loss.rotation_all": 1.0, "loss.hand": 0.1}
    assert len({run for trial in study.trials for run in trial.user_attrs["runs"]}) == 6
    values = [fake_search.error({"values": trial.params, "seed": 0}) for trial in study.trials]
    assert [trial.value for trial in study.trials] == pytest.approx(values)
    assert study.list_best()[0].value == pytest.approx(min(values))


@pytest.mark.parametrize("moment", range(4))
def test_a_director_killed_while_it_asks_loses_and_repeats_nothing(tmp_path: Path, monkeypatch, moment: int):
    """It dies before a new trial's first value, between its values, after them, or once its run is known."""
    study = fake_search.open_study(tmp_path)
    one = fake_search.director(study, tmp_path)
    fake_search.finish(one.update(1))
    before = [trial.number for trial in study.trials]

    calls = 0
    whole = study_module.suggest_value

    def killed(*arguments: Any) -> Value:
        nonlocal calls
        if calls == moment:
            raise KeyboardInterrupt
        calls += 1
        return whole(*arguments)

    def composed(values: Mapping[str, Value]) -> list[list[RunTask]]:
        if moment == 2:
            raise KeyboardInterrupt
        return fake_search.compose(values)

    with monkeypatch.context() as patch:
        patch.setattr(study_module, "suggest_value", killed)
        one.compose = composed
        if moment < 3:
            with pytest.raises(KeyboardInterrupt):
                one.update(1)
        else:
            one.update(1)
    study = fake_search.open_study(tmp_path)
    assert [trial.number for trial in study.trials] == [*before, 1]
    fake_search.to_the_end(study, tmp_path)
    assert [trial.number for trial in study.trials] == list(range(6))
    assert all(trial.state == TrialState.COMPLETE for trial in study.trials)
    assert all(set(trial.params) == {"loss.rotation_all", "loss.hand"} for trial in study.trials)
    assert len({tuple(trial.params.values()) for trial in study.trials}) == 6


def test_a_trial_worse_than_the_median_is_pruned_and_its_run_cancelled(tmp_path: Path):
    study = fake_search.open_study(tmp_path, pruner="median", prune_after=2)
    one = fake_search.director(study, tmp_path)
    for level in (5.0, 6.0):
        run = fake_search.begun(one.update(1))
        for step in (10, 20, 30):
            fake_search.log(run, step, level)
        run.finish([])
    run = fake_search.begun(one.update(1))
    fake_search.log(run, 10, 5.2)
    assert run.id in {task.id for task in one.update(1).tasks}  # better than the median of 5 and 6
    run.fail("not of interest here")
    failed = run.id
    run = fake_search.begun(one.update(1))
    fake_search.log(run, 10, 7.0)
    plan = one.update(1)
    assert set(plan.cancelled) == {run.id, failed}
    assert run.id not in {task.id for task in plan.tasks}
    states = [trial.state.name for trial in study.trials[:4]]
    assert states == ["COMPLETE", "COMPLETE", "FAIL", "PRUNED"]
    assert study.trials[0].intermediate_values == {10: 5.0, 20: 5.0, 30: 5.0}
    resumed = fake_search.director(fake_search.open_study(tmp_path, pruner="median", prune_after=2), tmp_path)
    assert set(resumed.update(1).cancelled) == {run.id, failed}


def test_a_failed_run_fails_its_trial_and_the_search_goes_on(tmp_path: Path):
    study = fake_search.open_study(tmp_path)
    one = fake_search.director(study, tmp_path)
    one.check = Mock(side_effect=[InputError("the clips have changed"), *[None] * 9])
    with pytest.raises(InputError, match="have changed"):
        one.update(1)
    fake_search.begun(one.update(1)).fail("the loss is nan")
    fake_search.to_the_end(study, tmp_path)
    assert study.trials[0].state == TrialState.FAIL
    assert study.trials[0].user_attrs["reason"] == "the loss is nan"
    assert [trial.state for trial in study.trials[1:]] == [TrialState.COMPLETE] * 5


def test_values_that_make_no_sense_fail_their_trial_and_hopeless_searches_end(tmp_path: Path):
    refuse = Mock(side_effect=InputError("hand=position needs positions"))
    with pytest.raises(InputError, match="all 5 trials failed; the last error: hand=position needs"):
        fake_search.director(fake_search.open_study(tmp_path, n_trials=20), tmp_path, refuse).update(2)


def test_the_other_seeds_wait_for_the_first_ones_end_and_count_for_capacity(tmp_path: Path):
    one = fake_search.seeded(fake_search.open_study(tmp_path, seeds=3), tmp_path)
    plan = one.update(2)
    assert [(entry.label, entry.seed) for entry in plan.entries] == [("trial 0", 0), ("trial 1", 0)]
    fake_search.finish(replace(plan, tasks=plan.tasks[:1]))
    plan = one.update(2)
    seeds = [(entry.label[-1], entry.seed) for entry in plan.entries]
    assert (seeds, len(plan.list_remaining())) == ([("0", 0), ("0", 1), ("0", 2), ("1", 0)], 3)
    assert one.update(4).entries[-1].label == "trial 2"


def test_pruning_is_by_the_first_seed_alone(tmp_path: Path):
    study = fake_search.open_study(tmp_path, seeds=2, pruner="median", prune_after=1)
    one = fake_search.seeded(study, tmp_path)
    for level in (5.0, 6.0):
        for _ in range(2):
            run = fake_search.begun(replace(plan := one.update(1), tasks=tuple(plan.list_remaining())))
            for step in (10, 20, fake_search.STEPS):
                fake_search.log(run, step, level)
            run.finish([])
    run = fake_search.begun(one.update(1))
    fake_search.log(run, 10, 50.0)
    run.finish([])  # done before the director looks, so that it is not pruned
    second = fake_search.begun(replace(plan := one.update(1), tasks=tuple(plan.list_remaining())))
    fake_search.log(second, 20, 50.0)  # a further bad seed enters the mean, but doesn't end the trial
    assert second.id in {task.id for task in one.update(1).list_remaining()}
    assert study.trials[2].intermediate_values == {10: 50.0}
    second.fail("not of interest here")
    run = fake_search.begun(one.update(1))
    fake_search.log(run, 10, 50.0)
    plan = one.update(1)
    assert run.id in plan.cancelled
    assert study.trials[-2].state == TrialState.PRUNED
    assert study.trials[-2].user_attrs["runs"] == [run.id]
