"""A plan: the runs that a sweep's variants and seeds need, their progress, and the remaining time.

A plan holds only the runs' identities; their progress is read from the run folders. Plans are made in
`config/compose_plan.py`, since that composes configs.
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


@dataclass(frozen=True)
class RunTask:
    """One run to be brought to its end.

    Attributes:
        id: the run's id.
        kind: the kind of run (see `Identity`).
        config: the resolved config of an experiment that needs the run.
        prerequisite: the id of the run that must be done first; None for none.
        stages: identities of the evaluations and the deployment that the run must have.
    """

    id: str
    kind: str
    config: Mapping[str, Any]
    prerequisite: str | None = None
    stages: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """The task's key, which no other task has: the run's id, and the stages that are wanted."""
        return " ".join((self.id, *self.stages))


@dataclass(frozen=True)
class Entry:
    """An entry of a sweep: the run of a variant with a seed, and its stages after training."""

    label: str
    seed: int
    id: str
    stages: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """The key of the entry's task."""
        return " ".join((self.id, *self.stages))


@dataclass(frozen=True)
class Plan:
    """The entries of a sweep, and the tasks that they need: each task once, after the tasks that it needs.

    Attributes:
        name: the sweep's name.
        outputs: the folder of runs and caches.
        entries: the runs of the sweep's variants and seeds.
        tasks: the runs to be made.
        open: whether tasks may be added, so that workers stay (a search); a sweep's plan is closed.
        cancelled: ids of runs that workers must not go on with.
    """

    name: str
    outputs: Path
    entries: tuple[Entry, ...]
    tasks: tuple[RunTask, ...]
    open: bool = False
    cancelled: tuple[str, ...] = ()

    def of_variants(self, labels: Iterable[str]) -> Plan:
        """Return the part of the plan that variants with these labels need, with their prerequisites."""
        chosen = set(labels)
        entries = tuple(entry for entry in self.entries if entry.label in chosen)
        wanted = {entry.key for entry in entries}
        for task in reversed(self.tasks):  # each before those that it needs, whose keys are their ids
            if task.key in wanted and task.prerequisite:
                wanted.add(task.prerequisite)
        return replace(self, entries=entries, tasks=tuple(task for task in self.tasks if task.key in wanted))

    def run(self, label: str, seed: int) -> Run | None:
        """Return the run of a variant with a seed, finished or not; None if its identity is not known."""
        found = self._by_entry.get((label, seed))
        return Run.from_id(self.outputs, found) if found else None

    @cached_property
    def _by_entry(self) -> dict[tuple[str, int], str]:
        return {(entry.label, entry.seed): entry.id for entry in self.entries}

    def run_of(self, task: RunTask | Entry) -> Run:
        """Return the run of a task or entry."""
        return Run.from_id(self.outputs, task.id)

    def complete(self, task: RunTask | Entry) -> bool:
        """Return whether the run is trained and has all wanted stages."""
        run = self.run_of(task)
        return run.done and all(map(run.has, task.stages))

    def states(self, before: Mapping[str, str] | None = None) -> dict[str, str]:
        """Return the state of every task by its key: its run's, or "blocked" if a prerequisite run failed.

        Args:
            before: states found earlier; tasks that were done then are taken to be done, without a look at
                their runs.
        """
        known = {key for key, state in (before or {}).items() if state == "done"}
        found = {}
        for task in self.tasks:
            found[task.key] = "done" if task.key in known else self.run_of(task).state(self.complete(task))
        return self.with_blocked(found)

    def with_blocked(self, states: Mapping[str, str]) -> dict[str, str]:
        """Return the states with "blocked" for tasks that have a failed prerequisite."""
        found = dict(states)
        for task in self.tasks:  # prerequisites come first
            if found[task.key] != "done" and found.get(task.prerequisite or "") in ("failed", "blocked"):
                found[task.key] = "blocked"
        return found

    def left(self, states: Mapping[str, str] | None = None) -> list[RunTask]:
        """Return the tasks that are still to be done.

        Tasks that are done, failed, blocked or cancelled are left out.

        Args:
            states: the tasks' states; by default they are looked up.
        """
        states = self.states() if states is None else states
        ended = ("done", "failed", "blocked")
        return [t for t in self.tasks if states[t.key] not in ended and t.id not in self.cancelled]

    def save(self, path: Path) -> None:
        """Write the plan to a file, completely or not at all."""
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, {**asdict(self), "outputs": str(self.outputs)})

    @classmethod
    def load(cls, path: Path) -> Plan:
        """Read a saved plan. Raises InputError if the file is not a plan."""
        try:
            content = json.loads(path.read_bytes())
            for name, kind in (("entries", Entry), ("tasks", RunTask)):
                content[name] = tuple(
                    kind(**{**fields, "stages": tuple(fields.get("stages", ()))}) for fields in content[name]
                )
            content["cancelled"] = tuple(content["cancelled"])
            return cls(**{**content, "outputs": Path(content["outputs"])})
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: not a sweep's plan ({error}); start the sweep again") from None


def unique(tasks: Iterable[RunTask]) -> tuple[RunTask, ...]:
    """Return each task once, in the given order, and prerequisites right before the first that needs them."""
    known = {task.key: task for task in tasks}
    order = (key for task in known.values() for key in (task.prerequisite, task.key) if key in known)
    return tuple(known[key] for key in dict.fromkeys(order))


class Forecast(NamedTuple):
    """The time that one worker would need for the remaining runs.

    Attributes:
        seconds: the time, seconds.
        finished: how many finished runs the estimate comes from.
    """

    seconds: float
    finished: int


def forecast(plan: Plan) -> Forecast | None:
    """Estimate each remaining run from the finished runs of its variant, else from those of its kind.

    Returns:
        None if nothing is left, or if no run of the kinds that are left has finished.
    """
    left = plan.left()
    unfinished = {task.id for task in left}  # the time of a trained run may lack that of an evaluation
    times: dict[str, float] = {}
    kinds: dict[str, list[str]] = defaultdict(list)
    for task in plan.tasks:
        if task.id not in unfinished and (seconds := run_seconds(plan.run_of(task))) is not None:
            times[task.id] = seconds
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


def run_seconds(run: Run) -> float | None:
    """Return how long a finished run took, all stages together; None if it has not finished."""
    found = run.manifest.get("seconds") if run.done else None
    return sum(found.values()) if isinstance(found, dict) else found
