"""How long a plan's remaining runs may take, estimated from its finished runs."""

from __future__ import annotations

from collections import defaultdict
from statistics import fmean
from typing import NamedTuple

from memmlp.runs.run import Run
from memmlp.sweep.plan import Plan, RunTask


class Forecast(NamedTuple):
    """The time that one worker would need for the remaining runs.

    Attributes:
        seconds: the time, seconds.
        finished: how many finished runs the estimate comes from.
        unlike: how many remaining runs belong to variants without a finished run, and are estimated from
            other variants.
    """

    seconds: float
    finished: int
    unlike: int


def forecast(plan: Plan) -> Forecast | None:
    """Estimate each remaining run from the finished runs of its variant, else from those of its kind.

    Returns:
        None if nothing is left, or if no run of the kinds that are left has finished.
    """
    left = plan.left()
    # A trained run may lack an evaluation that this plan wants, so that its time says too little.
    unfinished = {task.id for task in left}
    times = {task.id: seconds(plan.run_of(task)) for task in plan.tasks if task.id not in unfinished}
    took = {name: time for name, time in times.items() if time is not None}
    kinds: dict[str, list[str]] = defaultdict(list)
    for task in plan.tasks:
        if task.id in took:
            kinds[task.kind].append(task.id)
    if not left or not all(kinds[task.kind] for task in left):
        return None
    variants = [_variant(plan, task) for task in left]
    judged = [variant & took.keys() or kinds[task.kind] for variant, task in zip(variants, left, strict=True)]
    return Forecast(
        seconds=sum(fmean(took[name] for name in names) for names in judged),
        finished=len({name for names in judged for name in names}),
        unlike=sum(bool(variant) and not variant & took.keys() for variant in variants),
    )


def seconds(run: Run) -> float | None:
    """Return how long a finished run took, all stages together; None if it has not finished."""
    found = run.manifest.get("seconds") if run.done else None
    return sum(found.values()) if isinstance(found, dict) else found


def _variant(plan: Plan, task: RunTask) -> set[str]:
    """Return the ids of all seeds' runs of the variants that use a task's run; none for an upstream run."""
    labels = {entry.label for entry in plan.entries if entry.id == task.id}
    return {entry.id for entry in plan.entries if entry.label in labels}
