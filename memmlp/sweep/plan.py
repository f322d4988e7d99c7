"""A plan: the runs that a sweep's variants and seeds need, their progress, and the remaining time.

A plan stores the ids and configs of runs. Their progress is read from the run folders. Plans are made in
`config/compose_plan.py`, because making a plan composes configs.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from memmlp.common.errors import InputError
from memmlp.common.files import write_json
from memmlp.runs.run import Run

FAULTY = ("failed", "damaged", "stopped", "blocked")  # the states of tasks that no worker takes


@dataclass(frozen=True)
class RunTask:
    """A run that must be trained and evaluated: its id and kind (see `Identity`), the resolved config of an
    experiment that needs it, the id of the run that must be done first, and the identities of the required
    evaluations and deployment."""

    id: str
    kind: str
    config: Mapping[str, Any]
    prerequisite: str | None = None
    stages: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """The task's unique key: the run's id and its required stages."""
        return " ".join((self.id, *self.stages))


@dataclass(frozen=True)
class Entry:
    """The run of a variant with a seed, and its required stages after training."""

    label: str
    seed: int
    id: str
    stages: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        return " ".join((self.id, *self.stages))


@dataclass(frozen=True)
class Plan:
    """The entries of a sweep, one for each variant and seed, and the tasks that they need. Each task occurs
    once, after its prerequisite. `outputs` is the folder of runs and caches. If a plan is `open`, tasks may
    be added later, so workers wait for them: a search's plan is open until the search ends; a sweep's plan is
    closed. `cancelled` has the ids of runs that workers must stop."""

    name: str
    outputs: Path
    entries: tuple[Entry, ...]
    tasks: tuple[RunTask, ...]
    open: bool = False
    cancelled: tuple[str, ...] = ()

    def select_variants(self, labels: Iterable[str]) -> Plan:
        """Return a plan with only the variants with these labels, and the tasks that they need."""
        chosen = set(labels)
        entries = tuple(entry for entry in self.entries if entry.label in chosen)
        keys = {entry.key for entry in entries}
        for task in reversed(self.tasks):  # prerequisites come last; their keys are their ids
            if task.key in keys and task.prerequisite:
                keys.add(task.prerequisite)
        return replace(self, entries=entries, tasks=tuple(task for task in self.tasks if task.key in keys))

    def run(self, label: str, seed: int) -> Run | None:
        """Return the run of a variant with a seed; None if the plan does not have it."""
        found = self._run_ids.get((label, seed))
        return Run.from_id(self.outputs, found) if found else None

    @cached_property
    def _run_ids(self) -> dict[tuple[str, int], str]:
        return {(entry.label, entry.seed): entry.id for entry in self.entries}

    def get_run(self, task: RunTask | Entry) -> Run:
        return Run.from_id(self.outputs, task.id)

    def is_complete(self, task: RunTask | Entry) -> bool:
        """Return whether the run is trained and has all required stages."""
        run = self.get_run(task)
        return run.done and all(map(run.has, task.stages)) and not run.damage

    def read_states(self, before: Mapping[str, str] | None = None) -> dict[str, str]:
        """Return the state of each task's run by the task's key; "blocked" if a prerequisite run is FAULTY.
        Tasks that were done in the states `before` are not read again."""
        done = {key: state for key, state in (before or {}).items() if state == "done"}
        tasks = self.tasks
        states = {t.key: done.get(t.key) or self.get_run(t).state(self.is_complete(t)) for t in tasks}
        return self.mark_blocked(states)

    def mark_blocked(self, states: Mapping[str, str]) -> dict[str, str]:
        """Return the states, with "blocked" for each task after a failed prerequisite."""
        found = dict(states)
        for task in self.tasks:  # prerequisites come first
            if found[task.key] != "done" and found.get(task.prerequisite or "") in FAULTY:
                found[task.key] = "blocked"
        return found

    def list_remaining(self, states: Mapping[str, str] | None = None) -> list[RunTask]:
        """Return all tasks except tasks that are done, failed, blocked or cancelled; prioritized runs and
        their prerequisites come first. By default, the states are read from the run folders."""
        states = self.read_states() if states is None else states
        ended = ("done", *FAULTY)
        left = [t for t in self.tasks if states[t.key] not in ended and t.id not in self.cancelled]
        first = {task.id for task in left if self.get_run(task).is_prioritized}
        for task in reversed(left):  # prerequisites come before the tasks that need them
            if task.id in first and task.prerequisite:
                first.add(task.prerequisite)
        return sorted(left, key=lambda task: task.id not in first)

    def save(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, {**asdict(self), "outputs": str(self.outputs)})

    @classmethod
    def load(cls, path: Path) -> Plan:
        """Read a saved plan. Raises InputError for another file."""
        try:
            content = json.loads(path.read_bytes())
            for name, kind in (("entries", Entry), ("tasks", RunTask)):
                content[name] = tuple(
                    kind(**{**fields, "stages": tuple(fields.get("stages", ()))}) for fields in content[name]
                )
            content["cancelled"] = tuple(content["cancelled"])
            return cls(**{**content, "outputs": Path(content["outputs"])})
        except (OSError, ValueError, KeyError, TypeError) as error:
            expected = "must be the plan of a sweep"
            raise InputError(f"{path}: {expected} ({error}); start the sweep again") from None


def order_tasks(tasks: Iterable[RunTask]) -> tuple[RunTask, ...]:
    """Remove duplicate tasks, and move each prerequisite directly before the first task that needs it."""
    known = {task.key: task for task in tasks}
    order = (key for task in known.values() for key in (task.prerequisite, task.key) if key in known)
    return tuple(known[key] for key in dict.fromkeys(order))


class Forecast(NamedTuple):
    """An estimate of the seconds that one worker needs for the remaining runs, and the number of finished
    runs from which it is made."""

    seconds: float
    finished: int


def estimate_time(plan: Plan) -> Forecast | None:
    """Estimate the time of the remaining runs from finished runs: for a run the mean over its variant's
    finished runs, else over all finished runs of its kind. None if no run remains, or if a remaining kind of
    run has no finished run."""
    left = plan.list_remaining()
    unfinished = {task.id for task in left}  # it may be trained, but lack evaluations
    times: dict[str, float] = {}
    kinds: dict[str, list[str]] = defaultdict(list)
    for task in plan.tasks:
        run = plan.get_run(task)
        if task.id not in unfinished and run.done and (stages := run.manifest.get("seconds")):
            times[task.id] = sum(stages.values())
            kinds[task.kind].append(task.id)
    if not left or not all(kinds[task.kind] for task in left):
        return None
    total, used = 0.0, set[str]()
    for task in left:
        labels = {entry.label for entry in plan.entries if entry.id == task.id}
        same = {entry.id for entry in plan.entries if entry.label in labels}
        names = same & times.keys() or set(kinds[task.kind])
        total += fmean(times[name] for name in names)
        used |= names
    return Forecast(total, len(used))
