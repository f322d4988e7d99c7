"""The director of a search: it asks the study for trials, plans their runs, and records their results. A
trial has a run for each seed. The first seed's run decides whether the trial is pruned. The other seeds' runs
start after it."""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from optuna.trial import Trial, TrialState

from memmlp.common.errors import InputError
from memmlp.common.lease import check_owner
from memmlp.runs.identity import select_inference_config
from memmlp.runs.run import Run
from memmlp.sweep.controller import READ_INTERVAL, Fleet
from memmlp.sweep.plan import Entry, Plan, RunTask, order_tasks
from memmlp.sweep.search.progress_table import SearchBoard
from memmlp.sweep.search.search_file import Objective, Value
from memmlp.sweep.search.study import Study, get_values

MAX_FAILURES = 5  # the search ends if its first MAX_FAILURES trials all fail
DROPPED = (TrialState.PRUNED, TrialState.FAIL)  # states of trials that no longer need their runs

Compose = Callable[[Mapping[str, Value]], Sequence[Sequence[RunTask]]]
"""Makes a list of tasks for each seed from a trial's values. A list ends with the seed's own run. Raises
InputError if the config rejects the values."""


@dataclass
class RunningTrial:
    """A running trial, the tasks of each seed, of which the last is the seed's own run, and the number of
    seeds with requested runs."""

    trial: Trial
    seeds: Sequence[Sequence[RunTask]]
    seed_count: int = 0

    @property
    def tasks(self) -> list[RunTask]:
        return [task for tasks in self.seeds[: self.seed_count] for task in tasks]

    @property
    def runs(self) -> list[str]:
        """The ids of the seeds' requested runs, without prerequisite runs."""
        return [tasks[-1].id for tasks in self.seeds[: self.seed_count]]

    def request_seeds(self, count: int) -> None:
        """Request the runs of the first `count` seeds, and record their ids in the trial."""
        if count != self.seed_count:
            self.seed_count = count
            self.trial.set_user_attr("runs", self.runs)


class Director:
    """Starts and ends the trials of a study, and plans their runs. `compose` makes the tasks of a trial.
    `plan` is an empty, open plan, which gives its name and outputs folder to the plans of `update`. `check`
    is called before each new trial, and raises InputError to end the search."""

    def __init__(self, study: Study, compose: Compose, plan: Plan, check: Callable[[], None] = lambda: None):
        self.study, self.compose, self.plan, self.check = study, compose, plan, check
        self.running: dict[int, RunningTrial] = {}
        for trial in study.list_running():
            self._start(trial)

    def update(self, capacity: int) -> Plan:
        """Record finished trials, start new trials until `capacity` workers have a run, and return the plan.
        Raises InputError if at least MAX_FAILURES trials have ended and all of them failed, or if `check`
        refuses a new trial."""
        for number in list(self.running):
            if self._end_if_finished(self.running[number]):
                del self.running[number]
        while self._count_usable_workers() < capacity and not self.study.is_full:
            self.check()
            trial = self.study.ask()
            ended = [one for one in self.study.trials if one.state.is_finished()]
            if len(ended) >= MAX_FAILURES and all(one.state == TrialState.FAIL for one in ended):
                reason = ended[-1].user_attrs.get("reason", "for an unknown reason")
                raise InputError(f"all {len(ended)} trials failed; the last error: {reason}")
            self._start(trial)
        return self._make_plan()

    def _start(self, trial: Trial) -> None:
        """Request a trial's first run. The trial fails if the config rejects its values."""
        try:
            started = RunningTrial(trial, self.compose(get_values(trial, self.study.search)))
        except InputError as error:
            self.study.fail(trial, str(error))
            return
        started.request_seeds(1)
        self.running[trial.number] = started

    def _end_if_finished(self, one: RunningTrial) -> bool:
        """Record the trial in the study if it has ended, and return whether it has. When the first seed's run
        is done, the runs of the other seeds are requested."""
        last = [tasks[-1] for tasks in one.seeds]
        runs = [self.plan.get_run(task) for task in last]
        if damage := [line for task in one.tasks for line in self.plan.get_run(task).damage]:
            self.study.fail(one.trial, damage[0])
            return True
        for task, run in zip(last, runs, strict=True):
            used = select_inference_config(run.config) if run.done else None
            expected = select_inference_config(task.config)
            if used is not None and used != expected:
                self.study.fail(one.trial, f"run {run.id} was validated with {used}; expected {expected}")
                return True
        step = self._report_validations(one.trial, runs[0])
        if self.plan.is_complete(last[0]):
            one.request_seeds(len(runs))
        if all(map(self.plan.is_complete, last)):
            objectives = self.study.search.objectives
            self.study.complete(one.trial, [read_objectives(objectives, run) for run in runs])
            return True
        for task in one.tasks:
            if failure := self.plan.get_run(task).fault:
                self.study.fail(one.trial, failure)
                return True
        return one.seed_count == 1 and 0 < step < runs[0].total_steps and self.study.prune(one.trial)

    def _count_usable_workers(self) -> int:
        """Return the number of workers that the running trials can use: one for each unfinished run, and at
        least one for a trial until it has been recorded as ended."""
        outputs = self.plan.outputs
        left = ([not Run.from_id(outputs, name).done for name in one.runs] for one in self.running.values())
        return sum(max(1, sum(unfinished)) for unfinished in left)

    def _report_validations(self, trial: Trial, run: Run) -> int:
        """Report the run's new validations to the study, if the search has a single objective. Return the
        step of the last new validation, or 0."""
        (objective, *others) = self.study.search.objectives
        if others:
            return 0
        known = trial.study.get_trials(deepcopy=False)[trial.number].intermediate_values
        validations = (entry for entry in run.metrics() if entry.phase == "val")
        new = {e.step: objective.value(e.values) for e in validations if e.step not in known}
        for step, value in new.items():
            trial.report(value, step)
        return max(new, default=0)

    def _make_plan(self) -> Plan:
        entries = tuple(
            Entry(f"trial {number}", seed, run_id)
            for number, one in self.running.items()
            for seed, run_id in enumerate(one.runs)
        )
        dropped = [trial for trial in self.study.trials if trial.state in DROPPED]
        cancelled = {run_id for trial in dropped for run_id in trial.user_attrs.get("runs", ())}
        return replace(
            self.plan,
            entries=entries,
            tasks=order_tasks(task for one in self.running.values() for task in one.tasks),
            cancelled=tuple(sorted(cancelled - {entry.id for entry in entries})),
        )


def read_objectives(objectives: Sequence[Objective], run: Run) -> list[float]:
    """Return the value of each objective for a finished run's weights (`Run.kept_validation`). Raises
    InputError if the log was damaged and does not contain that validation."""
    kept, step = run.kept_validation, run.manifest.get("best_step") or run.total_steps
    if kept is None or kept.step != step:
        raise InputError(f"{run.metrics_path}: the validation at step {step} is missing; run it again")
    return [objective.value(kept.values) for objective in objectives]


def run_search(director: Director, fleet: Fleet, board: SearchBoard, path: Path) -> None:
    """Keep the fleet working until the study has all of its trials. The plan is written to `path`, which the
    workers read. The file is touched repeatedly to show that the director is alive."""
    plan = None
    try:
        with board:
            while plan is None or director.running:
                check_owner(path)
                before, plan = plan, director.update(fleet.size)
                if plan != before:
                    plan.save(path)
                os.utime(path)
                board.update(director.study)
                fleet.keep_workers_running(len(plan.list_remaining()))
                time.sleep(READ_INTERVAL)
        replace(plan, open=False).save(path)  # a closed plan lets the workers end
    except BaseException:
        fleet.cancel()
        raise
