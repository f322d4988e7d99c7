"""What a table gets from the runs of a planned sweep: results, states, and older runs.

A table never trains. It knows from the plan which identity the run of each variant and seed has, and reads
the folder outputs/runs/<id>/, whichever command made it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

from memmlp.runs.lookup import list_runs
from memmlp.runs.recipe_versions import outdated
from memmlp.runs.run import Run
from memmlp.sweep.definition import Variant
from memmlp.sweep.plan import Plan
from memmlp.tables.build_table import Find
from memmlp.tables.flags_of_runs import DescribeRun
from memmlp.tables.measured_run import Measured

Read = Callable[[Path, tuple[str, ...]], Measured]


def run_finder(plan: Plan, read: Read) -> Find:
    """Return a function that finds the results of the plan's finished run for a variant and a seed."""

    entries = {(entry.label, entry.seed): entry for entry in plan.entries}

    def find(variant: Variant, seed: int) -> Measured | None:
        entry = entries.get((variant.label, seed))
        complete = entry is not None and plan.complete(entry)
        return read(plan.run_of(entry).folder, entry.stages) if entry and complete else None

    return find


def state_finder(plan: Plan) -> DescribeRun:
    """Return a function that describes the state of an unfinished run of the plan, once it has begun."""

    entries = {(entry.label, entry.seed): entry for entry in plan.entries}

    def state(variant: Variant, seed: int) -> str | None:
        entry = entries.get((variant.label, seed))
        if entry is None:
            return None
        run = plan.run_of(entry)
        word = run.doing or run.state(plan.complete(entry))
        if word == "trained":
            return "trained, an evaluation or export is missing"
        return word if word not in ("new", "done") else None

    return state


def older_run_finder(plan: Plan) -> DescribeRun:
    """Return a function that names a finished run that differs from a planned one only in recipe versions."""
    whats = {task.key: task.what for task in plan.tasks}
    entries = {(entry.label, entry.seed): entry for entry in plan.entries}

    @functools.cache
    def known() -> dict[str, Run]:
        return {run.manifest.get("what", ""): run for run in list_runs(plan.outputs) if run.done}

    def say(variant: Variant, seed: int) -> str | None:
        entry = entries.get((variant.label, seed))
        run = known().get(whats.get(entry.key, "?")) if entry else None
        if entry is None or run is None or run.id == entry.id:
            return None
        changed = ", ".join(outdated(run.manifest.get("recipes", {}))) or "its VQ-VAE's"
        return f"run {run.id}: {changed}"

    return say
