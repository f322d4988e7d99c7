"""The server's answers about sweeps: progress, remaining time, and tables with effects and verdicts."""

import json
import math
import statistics
import threading
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any, NamedTuple

from memmlp.common.errors import InputError
from memmlp.common.files import find_packaged_folder, make_json_safe
from memmlp.common.text_formats import join_command
from memmlp.evaluation.metric_facts import UNITS
from memmlp.report.tables.build_table import find_finished_runs, make_table
from memmlp.report.tables.measured_run import MeasuredRun, load_measured_run
from memmlp.report.tables.seed_rounds import (
    ROUNDS_FILE,
    Rounds,
    check_same_runs,
    describe_subject,
    list_progress,
)
from memmlp.report.tables.statistics import Verdict
from memmlp.report.tables.table_text import find_direction, make_caption, make_heading, make_legend, to_json
from memmlp.report.ui.run_index import RunIndex, get_change_time
from memmlp.runs.identity import NETWORK, find_training_settings
from memmlp.runs.lookup import format_outputs_option
from memmlp.runs.run import STAGE_WORDS
from memmlp.sweep.definition import SWEEP_FILE, Sweep, Variant, load_sweep_copy
from memmlp.sweep.plan import FAULTY, Entry, Plan, RunTask
from memmlp.sweep.progress_table import describe_task

DAMAGED_ROUNDS = "seed rounds cannot be read: error probabilities of these verdicts may exceed 5 %"
OTHER_ROUNDS = "seed rounds belong to other runs: error probabilities of these verdicts may exceed 5 %"


class KnownSweep(NamedTuple):
    """A sweep in an outputs folder.

    Attributes:
        plan: the plan, named like the sweep's folder.
        sweep: the definition.
        stamp: the modification times of the sweep's files, nanoseconds.
    """

    plan: Plan
    sweep: Sweep
    stamp: tuple[int, ...]


class Sweeps:
    """The sweeps in an outputs folder.

    Attributes:
        damaged: error messages for unreadable sweeps, by folder name.
    """

    def __init__(self, index: RunIndex):
        self.index, self.lock = index, threading.Lock()
        self.known: dict[str, KnownSweep] = {}
        self.damaged: dict[str, str] = {}
        self.results: dict[str, tuple[Any, dict[str, Any]]] = {}

    def refresh(self) -> str:
        """Read changed sweeps, and return a text that changes when any sweep changes."""
        sweeps, damaged = {}, {}
        for path in self.index.outputs.glob("sweeps/*/plan.json"):
            folder, name = path.parent, path.parent.name
            stamp = tuple(get_change_time(folder / file) for file in (path.name, SWEEP_FILE, ROUNDS_FILE))
            before = self.known.get(name)
            try:
                if before and before.stamp == stamp:
                    sweeps[name] = before
                elif (sweep := load_sweep_copy(folder)) is None:
                    damaged[name] = f"{SWEEP_FILE} is missing; start the sweep again"
                else:
                    plan = replace(Plan.load(path), name=name, outputs=self.index.outputs)
                    sweeps[name] = KnownSweep(plan, sweep, stamp)
            except (InputError, OSError) as error:
                damaged[name] = str(error)
        newest = sorted(sweeps.items(), key=lambda item: -item[1].stamp[0])
        self.known, self.damaged = dict(newest), damaged
        return repr([(name, one.stamp) for name, one in newest])

    def list_rows(self) -> dict[str, Any]:
        """Return a row for each sweep, the last changed first."""
        rows = [self.describe_progress(one, self.find_states(one.plan)) for one in self.known.values()]
        return {"sweeps": rows, "damaged": self.damaged}

    def describe(self, name: str) -> dict[str, Any]:
        """Return the content of a sweep's page. Raises KeyError for an unknown sweep."""
        known_sweep = self.known[name]
        plan, states = known_sweep.plan, self.find_states(known_sweep.plan)
        results = self._get_results(known_sweep)
        values = results["values"]
        return {
            **self.describe_progress(known_sweep, states),
            **{key: value for key, value in results.items() if key != "values"},
            "cells": [
                self._describe_cell(e, states[e.key], values.get((e.label, e.seed))) for e in plan.entries
            ],
            "prerequisites": [
                {"name": describe_task(plan, task), "id": task.id, "state": states[task.key]}
                for task in plan.tasks
                if task.kind != NETWORK
            ],
        }

    def describe_progress(self, known_sweep: KnownSweep, states: Mapping[str, str]) -> dict[str, Any]:
        """Return a sweep's progress, given its tasks' states."""
        plan, sweep = known_sweep.plan, known_sweep.sweep
        counts = {True: Counter[str](), False: Counter[str]()}
        for task in plan.tasks:
            counts[task.kind == NETWORK][states[task.key]] += 1
        steps = {task.key: self._count_steps(task, states[task.key]) for task in plan.tasks}
        total = sum(number for number, _ in steps.values())
        # An unfinished run has at least one step left: its evaluation may be missing.
        left = sum(max(remaining, states[key] != "done") for key, (_, remaining) in steps.items())
        return {
            "name": plan.name,
            "title": f"Table {sweep.table}: {sweep.title}" if sweep.table else sweep.title,
            "variants": len({entry.label for entry in plan.entries}),
            "seeds": len({entry.seed for entry in plan.entries}),
            "wanted": len(sweep.seeds),
            "tasks": counts[True].total(),
            "counts": dict(counts[True]),
            "prerequisite_counts": dict(counts[False]),
            "share": 1 - left / total if total else 0.0,
            "remaining": self._estimate_remaining_seconds(plan, states, steps),
        }

    def find_control(self, run_id: str) -> str | None:
        """Return the id of the control's run with the same seed, or None.

        If several sweeps use the run, the first sweep with a control for it decides.
        """
        for plan, sweep, _ in self.known.values():
            ids = {(entry.label, entry.seed): entry.id for entry in plan.entries}
            controls = {variant.label: sweep.find_control(variant) for variant in sweep.variants}
            for label, seed in [place for place, used in ids.items() if used == run_id]:
                control = ids.get((controls.get(label) or "", seed), run_id)
                if control != run_id and control in self.index.runs:
                    return control
        return None

    def find_states(self, plan: Plan) -> dict[str, str]:
        """Return task states by key, like `Plan.states`, but from the facts in the index."""
        return plan.mark_blocked({task.key: self._find_state(plan, task) for task in plan.tasks})

    def _find_state(self, plan: Plan, task: RunTask) -> str:
        facts = self.index.runs.get(task.id)
        if facts is None:
            return "new"
        if not facts["done"] or facts["status"] not in ("done", "trained", "lost"):
            return facts["status"]
        run = plan.get_run(task)
        return run.activity or run.state(all(map(run.has, task.stages)))

    def _describe_cell(self, entry: Entry, state: str, value: float | None) -> dict[str, Any]:
        facts = self.index.runs.get(entry.id, {})
        recent = facts.get("recent") or [[0, 0, None]]
        return {
            "variant": entry.label, "seed": entry.seed, "id": entry.id, "state": state, "value": value,
            "step": recent[-1][0], "steps": facts.get("steps"),
            "failure": facts.get("failure") or "; ".join(facts.get("damage", ())),
        }  # fmt: skip

    def _count_steps(self, task: RunTask, state: str) -> tuple[int, int]:
        facts = self.index.runs.get(task.id) or {}
        total = int(facts.get("steps") or find_training_settings(task.kind, task.config)["steps"] or 0)
        last = facts["recent"][-1][0] if facts.get("recent") else 0
        return total, 0 if state == "done" else max(total - int(last), 0)

    def _estimate_remaining_seconds(
        self, plan: Plan, states: Mapping[str, str], steps: Mapping[str, tuple[int, int]]
    ) -> float | None:
        """Estimate the remaining time with the current number of busy workers, seconds, from the pace of
        training and the times of finished runs' evaluation and export. It is None without a busy worker, or
        if no pace is known."""
        running = [task for task in plan.tasks if states[task.key] in STAGE_WORDS.values()]
        found = (_estimate_pace(self.index.runs.get(task.id)) for task in plan.tasks)
        paces = [pace for pace in found if pace is not None]
        if not running or not paces:
            return None
        left = [task for task in plan.tasks if states[task.key] not in ("done", *FAULTY)]
        remaining = sum(steps[task.key][1] for task in left) * statistics.median(paces)
        after = self.index.estimate_seconds_after() or 0.0
        remaining += after * sum(task.kind == NETWORK for task in left)
        return remaining / len(running) if remaining else None

    def _get_results(self, known_sweep: KnownSweep) -> dict[str, Any]:
        """Return the results of a sweep's runs; compute them again if the sweep or a run has changed."""
        with self.lock:
            plan, runs = known_sweep.plan, self.index.runs
            stamp = known_sweep.stamp, [runs.get(entry.id, {}).get("signature") for entry in plan.entries]
            before = self.results.get(plan.name)
            if before is None or before[0] != stamp:
                before = self.results[plan.name] = (stamp, self._compute_results(known_sweep))
            return before[1]

    def _compute_results(self, known_sweep: KnownSweep) -> dict[str, Any]:
        plan, flags = known_sweep.plan, list[str]()
        rounds, flag = find_rounds(known_sweep.sweep, plan)
        sweep = rounds.restrict_sweep(known_sweep.sweep) if rounds else known_sweep.sweep
        entries = {(entry.label, entry.seed): entry for entry in plan.entries}
        metric = next((metric for metric in sweep.metrics if metric in UNITS), "MPJPE")
        values: dict[tuple[str, int], float] = {}

        def find_run(variant: Variant, seed: int) -> MeasuredRun | None:
            entry = entries.get((variant.label, seed))
            flags.extend(plan.get_run(entry).damage if entry else ())
            if entry is None or not plan.is_complete(entry):
                return None
            try:
                run = load_measured_run(plan.get_run(entry).folder, entry.stages)
                # Variants with the same trained network may have different evaluations.
                value = run.get_value("stream", variant.branch, metric)
            except InputError as error:
                flags.append(str(error))
                return None
            if value is not None and math.isfinite(value):
                values[variant.label, seed] = value
            return run

        runs = find_finished_runs(sweep, find_run)
        shipped = (find_packaged_folder("sweeps") / f"{sweep.name}.yaml").is_file()
        words = ["memmlp", "sweep", sweep.name if shipped else f"{sweep.name}.yaml", *sweep.command_line]
        words += [] if rounds else [f"seed={','.join(map(str, sweep.seeds))}"]
        command = join_command([*words, *format_outputs_option(plan.outputs)])
        table = make_table(sweep, runs, command=command, rounds=rounds)
        table = replace(table, flags=(*table.flags, *flag, *flags))
        branches = {variant.branch for variant in sweep.variants}
        return {
            "command": command,
            "metric": metric,
            "branch": branches.pop() if len(branches) == 1 else "",
            "table": {
                **json.loads(to_json(table)),
                "caption": make_caption(table),
                "headings": {metric: make_heading(metric) for metric in table.metrics},
                "better": {metric: find_direction(metric) for metric in table.metrics},
                "legend": make_legend(table),
            },
            "rounds": describe_rounds(rounds, sweep) if rounds else None,
            "values": values,
        }


def find_rounds(sweep: Sweep, plan: Plan) -> tuple[Rounds | None, list[str]]:
    """Return the seed rounds of a sweep, or None; a flag reports damaged rounds and rounds of other runs."""
    path = plan.outputs / "sweeps" / plan.name / ROUNDS_FILE
    try:
        rounds = Rounds.read(path)
        if rounds is None or not rounds.analyses:
            return None, []
        if rounds.subject != make_json_safe(describe_subject(sweep)):
            return None, [OTHER_ROUNDS]
        check_same_runs(rounds, sweep, plan, path)
    except InputError:
        return None, [DAMAGED_ROUNDS]
    return rounds, []


def describe_rounds(rounds: Rounds, sweep: Sweep) -> dict[str, Any]:
    """Return the interim analyses with their numbers of decisions, and each variant's progress."""
    analyses = []
    for seeds, level in zip(rounds.schedule, rounds.levels, strict=True):
        found = [finding for one in rounds.analyses if one.seeds == seeds for finding in one.findings]
        decided = sum(finding.verdict is not Verdict.INCONCLUSIVE for finding in found)
        analyses.append({"seeds": seeds, "level": level, "compared": len(found), "decided": decided})
    variants = [asdict(variant) for variant in list_progress(rounds, sweep)]
    comparisons = len(rounds.list_comparison_keys(sweep))
    return {"comparisons": comparisons, "analyses": analyses, "variants": variants}


def _estimate_pace(facts: Mapping[str, Any] | None) -> float | None:
    """Return a run's seconds per step, from its last log entries; None if there are too few entries."""
    recent = (facts or {}).get("recent") or []
    if len(recent) < 2 or recent[-1][0] <= recent[0][0]:
        return None
    seconds = recent[-1][1] - recent[0][1]
    plausible = 0 < seconds < 86400 and recent[-1][1] < time.time() + 60
    return seconds / (recent[-1][0] - recent[0][0]) if plausible else None
