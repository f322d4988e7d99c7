"""The content of the pages of sweeps: progress, remaining time, effects and verdicts."""

from __future__ import annotations

import json
import statistics
import threading
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, replace
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

from memmlp.common.errors import InputError
from memmlp.common.files import file_digest, plain
from memmlp.evaluation.metric_facts import UNITS
from memmlp.report.ui.index import Index
from memmlp.runs.identity import NETWORK, training_settings
from memmlp.runs.run import STAGE_WORDS
from memmlp.sweep.definition import Sweep, Variant
from memmlp.sweep.plan import Entry, Plan, RunTask
from memmlp.sweep.progress_table import name as task_name
from memmlp.sweep.sweep_file import parse_sweep
from memmlp.sweep.sweep_json import NAME as SWEEP_FILE
from memmlp.sweep.sweep_json import kept_sweep
from memmlp.tables.build_table import finished_runs, make_table
from memmlp.tables.formats import as_json
from memmlp.tables.measured_run import Measured, load
from memmlp.tables.seed_rounds import Rounds, standings, subject
from memmlp.tables.seed_rounds_file import NAME as ROUNDS_FILE
from memmlp.tables.seed_rounds_file import read as read_rounds
from memmlp.tables.seed_rounds_file import same_runs
from memmlp.tables.statistics import Verdict
from memmlp.tables.table_text import better, caption, heading, legend

ROUNDS = "seeds were spent in rounds; memmlp table has their verdicts, these do not keep the 5 %"
OTHERS = "seeds were spent in rounds, but not of these runs: these verdicts do not keep the 5 %"
NOT_KEPT = "this sweep's file was not kept with it, so its first arm is the control; memmlp table has its own"


class TableAndRounds(NamedTuple):
    """The results of a sweep's runs.

    Attributes:
        table: their table.
        rounds: the rounds, if seeds were spent in rounds.
        values: the shown metric by arm's label and seed, where it is a number.
    """

    table: dict[str, Any]
    rounds: dict[str, Any] | None
    values: dict[tuple[str, int], float]


class Sweeps:
    """The sweeps below an outputs folder."""

    def __init__(self, index: Index):
        self.index = index
        self.lock = threading.Lock()
        self.plans: dict[Path, tuple[int, Plan]] = {}
        self.tables: dict[str, tuple[Any, TableAndRounds]] = {}
        self.bad: dict[str, str] = {}

    def known(self) -> list[Plan]:
        """Return the plans of all sweeps, each under its folder's name, the most recently changed first."""
        found: dict[Path, tuple[int, Plan]] = {}
        self.bad = {}
        for path in self.index.outputs.glob("sweeps/*/plan.json"):
            try:
                changed = path.stat().st_mtime_ns
                before = self.plans.get(path)
                plan = before[1] if before and before[0] == changed else Plan.load(path)
                found[path] = (changed, replace(plan, name=path.parent.name, outputs=self.index.outputs))
            except (InputError, OSError) as error:
                self.bad[path.parent.name] = str(error)
        self.plans = found
        return [plan for _, plan in sorted(found.values(), key=lambda one: -one[0])]

    def stamp(self) -> str:
        """Return a text that changes when a sweep appears, goes, changes, is planned anew, or has a look."""
        found = [(path, seen) for path, (seen, _) in sorted(self.plans.items())]
        beside = [[_changed(path.with_name(name)) for name in (SWEEP_FILE, ROUNDS_FILE)] for path, _ in found]
        return repr([(str(path), seen, *others) for (path, seen), others in zip(found, beside, strict=True)])

    def rows(self) -> dict[str, Any]:
        """Return a row for each sweep."""
        return {"sweeps": [self.progress(plan) for plan in self.known()], "damaged": self.bad}

    def progress(self, plan: Plan) -> dict[str, Any]:
        """Return the progress of a sweep."""
        states = self.states(plan)
        counts = {kind: Counter(states[task.key] for task in tasks) for kind, tasks in _kinds(plan).items()}
        sweep = self._kept(plan.name)
        return {
            "name": plan.name,
            "title": caption_of(sweep) if sweep else plan.name,
            "arms": len({entry.label for entry in plan.entries}),
            "seeds": len({entry.seed for entry in plan.entries}),
            "tasks": len(_kinds(plan)["networks"]),
            "counts": dict(counts["networks"]),
            "above": dict(counts["upstream"]),
            "share": self._share(plan, states),
            "left": self._time_left(plan, states),
        }

    def page(self, name: str) -> dict[str, Any]:
        """Return everything that a sweep's page shows. Raises KeyError for an unknown sweep."""
        plan = next((plan for plan in self.known() if plan.name == name), None)
        if plan is None:
            raise KeyError(name)
        states = self.states(plan)
        sweep = self._kept(name) or sweep_of_plan(plan)
        made = self.made(plan)
        cells = [self._cell(entry, states, made) for entry in plan.entries]
        upstream = [self._upstream(plan, task, states) for task in plan.tasks if task.kind != NETWORK]
        branches = {arm.branch for arm in sweep.variants}
        found = {
            "metric": _shown_metric(sweep),
            "branch": branches.pop() if len(branches) == 1 else "",
            "cells": cells,
            "upstream": upstream,
            "table": made.table,
            "rounds": made.rounds,
        }
        return self.progress(plan) | found

    def control_of(self, run_id: str) -> str | None:
        """Return the run of the same seed with which a run's arm is compared; None for none.

        If several sweeps use the run, the first one in which its arm has a control decides.
        """
        for plan in self.known():
            ids = {(entry.label, entry.seed): entry.id for entry in plan.entries}
            for label, seed in [place for place, used in ids.items() if used == run_id]:
                control = ids.get((self._control(plan, label), seed), run_id)
                if control != run_id and control in self.index.runs:
                    return control
        return None

    def _control(self, plan: Plan, label: str) -> str:
        """Return the label of an arm's control; empty for none."""
        sweep = self._kept(plan.name) or sweep_of_plan(plan)
        return next((sweep.control_of(arm) or "" for arm in sweep.variants if arm.label == label), "")

    def states(self, plan: Plan) -> dict[str, str]:
        """Return every task's state by its key, as `Plan.states` does, from the facts in the index."""
        return plan.with_blocked({task.key: self._state(plan, task) for task in plan.tasks})

    def _state(self, plan: Plan, task: RunTask) -> str:
        facts = self.index.runs.get(task.id)
        if facts is None:
            return "new"
        if not facts["done"] or facts["status"] not in ("done", "trained", "lost"):
            return facts["status"]
        run = plan.run_of(task)
        return "done" if all(map(run.has, task.stages)) else run.doing or run.state(False)

    def _cell(self, entry: Entry, states: Mapping[str, str], made: TableAndRounds) -> dict[str, Any]:
        facts = self.index.runs.get(entry.id, {})
        recent = facts.get("recent") or [[0, 0, None]]
        return {
            "arm": entry.label, "seed": entry.seed, "id": entry.id, "state": states[entry.key],
            "step": recent[-1][0], "steps": facts.get("steps"), "failure": facts.get("failure", ""),
            "value": made.values.get((entry.label, entry.seed)),
        }  # fmt: skip

    def _upstream(self, plan: Plan, task: RunTask, states: Mapping[str, str]) -> dict[str, Any]:
        return {"name": task_name(plan, task), "id": task.id, "state": states[task.key]}

    def _left(self, task: RunTask, state: str) -> int:
        """Return the number of remaining steps of a task's training."""
        total = int(training_settings(task.kind, task.config)["steps"] or 0)
        facts = self.index.runs.get(task.id)
        if state == "done" or facts is None or not facts["recent"]:
            return 0 if state == "done" else total
        return max(total - int(facts["recent"][-1][0]), 0)

    def _share(self, plan: Plan, states: Mapping[str, str]) -> float:
        """Return the share of all steps that is done; a run that is not done has at least one step left."""
        total = sum(
            self._left(task, "new")
            if task.id not in self.index.runs
            else int(self.index.runs[task.id]["steps"] or 0)
            for task in plan.tasks
        )
        each = [(task, states[task.key]) for task in plan.tasks]
        left = sum(max(self._left(task, state), state != "done") for task, state in each)
        return 1 - left / total if total else 0.0

    def _time_left(self, plan: Plan, states: Mapping[str, str]) -> float | None:
        """Return the estimated seconds of training left for the workers that train at present.

        It is None if nobody trains, or if everything is trained.
        """
        running = [task for task in plan.tasks if states[task.key] in STAGE_WORDS.values()]
        paces = [pace for task in plan.tasks if (pace := _pace(self.index.runs.get(task.id))) is not None]
        if not running or not paces:
            return None
        left = sum(
            self._left(task, states[task.key])
            for task in plan.tasks
            if states[task.key] not in ("failed", "blocked")
        )
        return left * statistics.median(paces) / len(running) if left else None

    def made(self, plan: Plan) -> TableAndRounds:
        """Return the results of a sweep's runs.

        They are computed again if a run, the sweep, its plan or its rounds changed.
        """
        with self.lock:
            runs = [self.index.signatures.get(entry.id) for entry in plan.entries]
            folder = self.index.outputs / "sweeps" / plan.name
            stamp = (plan, runs, _digest(folder / SWEEP_FILE), _digest(folder / ROUNDS_FILE))
            known = self.tables.get(plan.name)
            if known and known[0] == stamp:
                return known[1]
            made = self._make(plan)
            self.tables[plan.name] = (stamp, made)
            return made

    def _make(self, plan: Plan) -> TableAndRounds:
        flags: list[str] = []
        sweep = self._kept(plan.name)
        if sweep is None:
            sweep, flags = sweep_of_plan(plan), [NOT_KEPT]
        rounds, doubts = rounds_of(sweep, plan, self._rounds_path(plan)) if not flags else (None, [])
        sweep = rounds.spent(sweep) if rounds else sweep
        flags += doubts
        entries = {(entry.label, entry.seed): entry for entry in plan.entries}
        metric = _shown_metric(sweep)
        values: dict[tuple[str, int], float] = {}

        def find(arm: Variant, seed: int) -> Measured | None:
            entry = entries.get((arm.label, seed))
            if entry is None or not plan.complete(entry):
                return None
            try:
                run = load(plan.run_of(entry).folder, entry.stages)
                # Of this arm's own evaluation: arms that share a training may use its network in other ways.
                value = run.value("stream", arm.branch, metric)
                values.update({(arm.label, seed): value} if value is not None and isfinite(value) else {})
                return run
            except InputError as error:
                flags.append(str(error))
                return None

        made = make_table(sweep, finished_runs(sweep, find), rounds=rounds)
        table = table_words(replace(made, flags=(*made.flags, *flags)))
        return TableAndRounds(table, rounds_words(rounds, sweep) if rounds else None, values)

    def _rounds_path(self, plan: Plan) -> Path:
        return self.index.outputs / "sweeps" / plan.name / ROUNDS_FILE

    def _kept(self, name: str) -> Sweep | None:
        try:
            return kept_sweep(self.index.outputs / "sweeps" / name)
        except InputError:
            return None


def _shown_metric(sweep: Sweep) -> str:
    """Return the metric that the cells of a sweep's page show."""
    return next((metric for metric in sweep.metrics if metric in UNITS), "MPJPE")


def rounds_of(sweep: Sweep, plan: Plan, path: Path) -> tuple[Rounds | None, list[str]]:
    """Return the rounds that decided the verdicts, None for none, and otherwise what a reader has to know."""
    try:
        rounds = read_rounds(path)
        if rounds is None or not rounds.taken:
            return None, []
        if rounds.subject != plain(subject(sweep)):
            return None, [OTHERS]
        same_runs(rounds, sweep, plan, path)
    except InputError:
        return None, [ROUNDS]
    return rounds, []


def rounds_words(rounds: Rounds, sweep: Sweep) -> dict[str, Any]:
    """Return the looks of a sweep's rounds, what each look decided, and each arm's progress."""
    looks = []
    for seeds, level in zip(rounds.looks, rounds.levels, strict=True):
        found = [finding for look in rounds.taken if look.seeds == seeds for finding in look.found]
        decided = sum(finding.verdict is not Verdict.INCONCLUSIVE for finding in found)
        looks.append({"seeds": seeds, "level": level, "compared": len(found), "decided": decided})
    return {
        "comparisons": len(rounds.family(sweep)),
        "looks": looks,
        "arms": [asdict(arm) for arm in standings(rounds, sweep)],
    }


def table_words(table: Any) -> dict[str, Any]:
    """Return a table's content, with its columns' heads, their better directions, and the legend."""
    words = json.loads(as_json(table))
    return {
        **words,
        "caption": caption(table),
        "headings": {m: heading(m) for m in table.metrics},
        "better": {m: better(m) for m in table.metrics},
        "legend": legend(table),
    }


def _kinds(plan: Plan) -> dict[str, list[RunTask]]:
    """Return a plan's tasks in two groups: networks, which are arms and seeds, and their upstream runs."""
    found: dict[str, list[RunTask]] = {"networks": [], "upstream": []}
    for task in plan.tasks:
        found["networks" if task.kind == NETWORK else "upstream"].append(task)
    return found


def caption_of(sweep: Sweep) -> str:
    """Return a sweep's title, with its table's number in the paper."""
    return f"Table {sweep.table}: {sweep.title}" if sweep.table else sweep.title


def sweep_of_plan(plan: Plan) -> Sweep:
    """Return a sweep with a plan's arms and seeds, of which the first arm is the control."""
    seeds = list(dict.fromkeys(entry.seed for entry in plan.entries)) or [0]
    arms: dict[str, list[str]] = {
        label: [] for label in dict.fromkeys(entry.label for entry in plan.entries)
    } or {"-": []}
    return parse_sweep(plan.name, {"title": plan.name, "seeds": seeds, "variants": arms})


def _changed(path: Path) -> int:
    """Return when a file was last changed, in nanoseconds; 0 if there is none."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def _digest(path: Path) -> str:
    """Return the digest of a file's content; "" if there is no file."""
    try:
        return file_digest(path)
    except OSError:
        return ""


def _pace(facts: Mapping[str, Any] | None) -> float | None:
    """Return a run's seconds per step over its last entries; None if they are not enough to tell."""
    recent = (facts or {}).get("recent") or []
    if len(recent) < 2 or recent[-1][0] <= recent[0][0]:
        return None
    seconds = recent[-1][1] - recent[0][1]
    return (
        seconds / (recent[-1][0] - recent[0][0])
        if 0 < seconds < 86400 and recent[-1][1] < time.time() + 60
        else None
    )
