"""A plan: which runs a sweep's arms and seeds are, and how far they are. The run folders say the latter."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.files import write_json
from memmlp.runs.run import Run


@dataclass(frozen=True)
class RunTask:
    """One run to be brought to its end.

    Attributes:
        id: of the run. kind: "vqvae" or "memmlp".
        config: the resolved config of an experiment that needs it.
        upstream: the run that must be done before; None for none.
        stages: identities of the evaluations and the deployment that are wanted of it.
        what: what it has in common with runs of other recipe numbers (`Identity.what`).
    """

    id: str
    kind: str
    config: Mapping[str, Any]
    upstream: str | None = None
    stages: tuple[str, ...] = ()
    what: str = ""

    @property
    def key(self) -> str:
        """What tells it from others: arms may want other evaluations of the same run."""
        return " ".join((self.id, *self.stages))


@dataclass(frozen=True)
class Entry:
    """A cell of the sweep: the run of an arm with a seed, and the stages that the arm shows of it."""

    label: str
    seed: int
    id: str
    stages: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """That of its task."""
        return " ".join((self.id, *self.stages))


@dataclass(frozen=True)
class Plan:
    """The entries of a sweep and the tasks they need, each once, upstream runs before those that need them.

    Attributes:
        name: of the sweep. outputs: folder of the runs' folder.
        open: more tasks may come, so workers stay (a search); a sweep's plan is closed.
        cancelled: ids that no worker shall go on with.
        fail_fast: the first failed run ends the sweep.
    """

    name: str
    outputs: Path
    entries: tuple[Entry, ...]
    tasks: tuple[RunTask, ...]
    open: bool = False
    cancelled: tuple[str, ...] = ()
    fail_fast: bool = False

    def run(self, label: str, seed: int) -> Run | None:
        """The run of an arm with a seed, finished or not; None where its identity is not known."""
        found = self._by_cell.get((label, seed))
        return Run.of(self.outputs, found) if found else None

    @cached_property
    def _by_cell(self) -> dict[tuple[str, int], str]:
        return {(entry.label, entry.seed): entry.id for entry in self.entries}

    def run_of(self, task: RunTask | Entry) -> Run:
        """The run of a task."""
        return Run.of(self.outputs, task.id)

    def complete(self, task: RunTask | Entry) -> bool:
        """Whether the run is trained and all of its stages that are wanted were made."""
        run = self.run_of(task)
        return run.done and all(map(run.has, task.stages))

    def states(self) -> dict[str, str]:
        """The state of every task by its key: its run's, or "blocked" where its upstream run failed."""
        states = {task.key: self.run_of(task).state(self.complete(task)) for task in self.tasks}
        for task in self.tasks:
            if states[task.key] != "done" and states.get(task.upstream or "") == "failed":
                states[task.key] = "blocked"
        return states

    def left(self) -> list[RunTask]:
        """The tasks that are neither done nor failed nor blocked nor cancelled; none of a stopped plan."""
        if self.stopped:
            return []
        states = self.states()
        ended = ("done", "failed", "blocked")
        return [t for t in self.tasks if states[t.key] not in ended and t.id not in self.cancelled]

    @property
    def stopped(self) -> bool:
        """Whether a run failed in a plan that the first failure ends."""
        return self.fail_fast and "failed" in self.states().values()

    def counts(self) -> Counter[str]:
        """How many tasks are in which state."""
        return Counter(self.states().values())

    def save(self, path: Path) -> None:
        """Write the plan, whole or not at all."""
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, {**asdict(self), "outputs": str(self.outputs)})

    @classmethod
    def load(cls, path: Path) -> Plan:
        """A saved plan. Raises InputError where the file is none."""
        try:
            content = json.loads(path.read_bytes())
            content["entries"] = tuple(Entry(**_stages(entry)) for entry in content["entries"])
            content["tasks"] = tuple(RunTask(**_stages(task)) for task in content["tasks"])
            content["cancelled"] = tuple(content["cancelled"])
            return cls(**{**content, "outputs": Path(content["outputs"])})
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: not a sweep's plan ({error}); start the sweep again") from None


def _stages(fields: dict[str, Any]) -> dict[str, Any]:
    """The fields of a task or entry, its stages as they were before they were JSON."""
    return fields | {"stages": tuple(fields.get("stages", ()))}


def unique(tasks: Iterable[RunTask]) -> tuple[RunTask, ...]:
    """Each task once, in the order given, an upstream run right before the first task that needs it."""
    known = {task.key: task for task in tasks}
    order = (key for task in known.values() for key in (task.upstream, task.key) if key in known)
    return tuple(known[key] for key in dict.fromkeys(order))
