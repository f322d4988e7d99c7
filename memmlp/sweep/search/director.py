"""The director of a search: it asks the study for trials, plans their runs, and records how they ended.

A trial has a run for each seed. The first seed's run decides whether the trial is pruned; the runs of the
other seeds follow after it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from optuna.trial import Trial, TrialState

from memmlp.common.errors import InputError
from memmlp.common.lease import check_owner
from memmlp.runs.identity import select_inference_config
from memmlp.runs.metrics_log import LogRecord
from memmlp.runs.run import Run
from memmlp.sweep.controller import LOOK, Fleet
from memmlp.sweep.plan import Entry, Plan, RunTask, unique
from memmlp.sweep.progress_table import total_steps
from memmlp.sweep.search.progress_table import SearchBoard
from memmlp.sweep.search.search_file import Objective, Value
from memmlp.sweep.search.study import Study, trial_values

MAX_FAILURES = 5  # so many trials that all fail end the search
DROPPED = (TrialState.PRUNED, TrialState.FAIL)  # states of trials that no longer need their runs

Compose = Callable[[Mapping[str, Value]], Sequence[Sequence[RunTask]]]
"""Makes a list of tasks for each seed from a trial's values; the last task of a list is the seed's run.

Raises InputError if the config rejects the values.
"""


@dataclass
class RunningTrial:
    """A running trial.

    Attributes:
        trial: the trial.
        seeds: the tasks of each seed; the last task of a seed is the seed's own run.
        wanted: for how many seeds runs are wanted so far.
    """

    trial: Trial
    seeds: Sequence[Sequence[RunTask]]
    wanted: int = 0

    @property
    def tasks(self) -> list[RunTask]:
        """The tasks that are wanted so far."""
        return [task for tasks in self.seeds[: self.wanted] for task in tasks]

    @property
    def runs(self) -> list[str]:
        """The ids of the seeds' runs that are wanted so far."""
        return [tasks[-1].id for tasks in self.seeds[: self.wanted]]

    def want(self, count: int) -> None:
        """Set for how many seeds runs are wanted, and record the ids of these runs with the trial."""
        if count != self.wanted:
            self.wanted = count
            self.trial.set_user_attr("runs", self.runs)


class Director:
    """The running trials, and the plan of their runs.

    Args:
        study: owns the trials.
        compose: makes the tasks of a trial.
        plan: an empty, open plan, which is filled with the tasks of the running trials.
        check: called before each new trial; it raises InputError to end the search.
    """

    def __init__(self, study: Study, compose: Compose, plan: Plan, check: Callable[[], None] = lambda: None):
        self.study, self.compose, self.plan, self.check = study, compose, plan, check
        self.running: dict[int, RunningTrial] = {}
        for trial in study.running():
            self._start(trial)

    def update(self, capacity: int) -> Plan:
        """Record ended trials, ask for new ones until `capacity` runs can run at once, and return the plan.

        Raises:
            InputError: if all trials failed, and there are at least MAX_FAILURES of them, or if `check`
                refuses a new trial.
        """
        for number in list(self.running):
            if self._end_if_over(self.running[number]):
                del self.running[number]
        while self._busy() < capacity and not self.study.full:
            self.check()
            trial = self.study.ask()
            ended = [one for one in self.study.trials if one.state.is_finished()]
            if len(ended) >= MAX_FAILURES and all(one.state == TrialState.FAIL for one in ended):
                reason = ended[-1].user_attrs.get("reason", "for an unknown reason")
                raise InputError(f"all {len(ended)} trials failed, the last one: {reason}")
            self._start(trial)
        return self._make_plan()

    def _start(self, trial: Trial) -> None:
        """Add a trial's first run to the plan. A trial fails at once if the config rejects its values."""
        try:
            started = RunningTrial(trial, self.compose(trial_values(trial, self.study.search)))
        except InputError as error:
            self.study.fail(trial, str(error))
            return
        trial.set_user_attr("steps", total_steps(started.seeds[0][-1]))
        started.want(1)
        self.running[trial.number] = started

    def _end_if_over(self, one: RunningTrial) -> bool:
        """Return whether the trial has ended, and record it with the study if so.

        Once its first run is done, the trial wants the runs of the other seeds.
        """
        last = [tasks[-1] for tasks in one.seeds]
        runs = [self.plan.run_of(task) for task in last]
        for task, run in zip(last, runs, strict=True):
            used, wanted = (
                select_inference_config(run.config) if run.done else None,
                select_inference_config(task.config),
            )
            if used is not None and used != wanted:
                self.study.fail(one.trial, f"run {run.id} was validated with {used}, not {wanted}")
                return True
        step = self._report(one.trial, runs[0])
        if self.plan.complete(last[0]):
            one.want(len(runs))
        if all(map(self.plan.complete, last)):
            self.study.complete(one.trial, [objectives(self.study.search.objectives, run) for run in runs])
            return True
        for task in one.tasks:
            if failure := self.plan.run_of(task).failure:
                self.study.fail(one.trial, failure)
                return True
        return one.wanted == 1 and 0 < step < total_steps(last[0]) and self.study.prune(one.trial)

    def _busy(self) -> int:
        """Return how many workers the running trials can use: one for each wanted run that is not done.

        A trial with only finished runs still counts as one until it is recorded as ended.
        """
        outputs = self.plan.outputs
        return sum(
            max(1, sum(not Run.from_id(outputs, name).done for name in one.runs))
            for one in self.running.values()
        )

    def _report(self, trial: Trial, run: Run) -> int:
        """Report the run's new validations to the study, if there is only one objective.

        Returns:
            The step of the last new validation; 0 without one.
        """
        (objective, *others) = self.study.search.objectives
        if others:
            return 0
        known = trial.study.get_trials(deepcopy=False)[trial.number].intermediate_values
        new = {e.step: objective.value(e.values) for e in validations(run) if e.step not in known}
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
            tasks=unique(task for one in self.running.values() for task in one.tasks),
            cancelled=tuple(sorted(cancelled - {entry.id for entry in entries})),
        )


def validations(run: Run) -> list[LogRecord]:
    """Return a run's logged results on the validation split."""
    return [entry for entry in run.metrics() if entry.phase == "val"]


def objectives(wanted: Sequence[Objective], run: Run) -> list[float]:
    """Return the objectives' values at a finished run's last validation.

    Raises:
        InputError: if the log lacks that validation, because it was damaged.
    """
    found, steps = validations(run), run.config["optim"]["steps"]
    if not found or found[-1].step != steps:
        raise InputError(f"{run.metrics_path}: lacks the validation at step {steps}; do the run again")
    return [objective.value(found[-1].values) for objective in wanted]


def direct(director: Director, fleet: Fleet, board: SearchBoard, path: Path) -> None:
    """Keep the fleet working on the trials' runs until the study has all the trials that it wants.

    `path` is the file of the plan, which the workers read. The file is touched repeatedly, as a sign that the
    director is alive.
    """
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
                fleet.keep(len(plan.left()))
                time.sleep(LOOK)
        replace(plan, open=False).save(path)  # workers end by themselves
    except BaseException:
        fleet.cancel()
        raise
