"""The director of a search: asks the study for trials, has their runs made, and tells how they ended."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from optuna.trial import Trial, TrialState

from memmlp.errors import InputError
from memmlp.runs import Metrics, Run
from memmlp.search.board import SearchBoard
from memmlp.search.spec import Objective, Value
from memmlp.search.study import Study, values
from memmlp.sweep.board import total_steps
from memmlp.sweep.controller import LOOK, Fleet
from memmlp.sweep.plan import Entry, Plan, Task, unique

HOPELESS = 5  # trials that fail before any other ends

Compose = Callable[[Mapping[str, Value]], Sequence[Task]]
"""From a trial's values to the tasks of its run, its own the last; InputError where they make no sense."""


class Director:
    """The trials under way and the plan of their runs.

    Args:
        study: owns the trials. compose: see above.
        plan: an empty one, open; its tasks become those of the trials under way.
    """

    def __init__(self, study: Study, compose: Compose, plan: Plan):
        self.study, self.compose, self.plan = study, compose, plan
        self.going: dict[int, tuple[Trial, Sequence[Task]]] = {}
        for trial in study.running():
            self._begin(trial)

    def look(self, capacity: int) -> Plan:
        """Tell what ended, ask for new trials up to `capacity` at once, and give the plan as it is now.

        Raises InputError when the first trials all failed.
        """
        for number in list(self.going):
            if self._ended(*self.going[number]):
                del self.going[number]
        while len(self.going) < capacity and (trial := self.study.ask()):
            self._check_hope()
            self._begin(trial)
        return self._planned()

    def _begin(self, trial: Trial) -> None:
        """Take a trial's run into the plan; a trial whose values make no sense fails."""
        try:
            tasks = self.compose(values(trial, self.study.search))
        except InputError as error:
            self.study.fail(trial, str(error))
            return
        trial.set_user_attr("steps", total_steps(tasks[-1]))
        trial.set_user_attr("run", tasks[-1].id)
        self.going[trial.number] = trial, tasks

    def _ended(self, trial: Trial, tasks: Sequence[Task]) -> bool:
        """Whether the trial has ended; the study is told."""
        run = self.plan.run_of(tasks[-1])
        news = self._report(trial, run)
        if self.plan.complete(tasks[-1]):
            self.study.complete(trial, objectives(self.study.search.objectives, run))
            return True
        for task in tasks:
            if failure := self.plan.run_of(task).failure:
                self.study.fail(trial, failure)
                return True
        return 0 < news < total_steps(tasks[-1]) and self.study.prune(trial)

    def _report(self, trial: Trial, run: Run) -> int:
        """Report the run's new validations, where there is one objective; the last one's step, 0 for none."""
        (objective, *others) = self.study.search.objectives
        if others:
            return 0
        known = trial.study.get_trials(deepcopy=False)[trial.number].intermediate_values
        news = {e.step: objective.value(e.values) for e in validations(run) if e.step not in known}
        for step, value in news.items():
            self.study.report(trial, step, value)
        return max(news, default=0)

    def _planned(self) -> Plan:
        """The plan of the trials under way; runs of pruned trials are cancelled."""
        wanted = [(number, tasks[-1].id) for number, (_, tasks) in self.going.items()]
        pruned = {t.user_attrs.get("run", "") for t in self.study.trials if t.state == TrialState.PRUNED}
        return replace(
            self.plan,
            entries=tuple(Entry(f"trial {number}", 0, run_id) for number, run_id in wanted),
            tasks=unique(task for _, tasks in self.going.values() for task in tasks),
            cancelled=tuple(sorted(pruned - {run_id for _, run_id in wanted})),
        )

    def _check_hope(self) -> None:
        """Raise InputError when all trials so far failed, and they are not few."""
        ended = [trial for trial in self.study.trials if trial.state.is_finished()]
        if len(ended) >= HOPELESS and all(trial.state == TrialState.FAIL for trial in ended):
            reason = ended[-1].user_attrs.get("reason", "no reason is known")
            raise InputError(f"all {len(ended)} trials failed, the last one so: {reason}")


def validations(run: Run) -> list[Metrics]:
    """What a run logged of its validation split."""
    return [entry for entry in run.metrics() if entry.phase == "val"]


def objectives(wanted: Sequence[Objective], run: Run) -> list[float]:
    """The objectives' values at a finished run's last validation."""
    last = validations(run)[-1].values
    return [objective.value(last) for objective in wanted]


def direct(director: Director, fleet: Fleet, board: SearchBoard, path: Path) -> None:
    """Keep the fleet at the trials' runs until the study has all it wants.

    path: the plan's file, which the workers read; it is touched while there is a director.
    """
    plan = None
    try:
        with board:
            while plan is None or director.going:
                before, plan = plan, director.look(fleet.size)
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
