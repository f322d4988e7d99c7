"""Which runs of a variant were timed without other work on the machine: the times of tables are of these."""

from __future__ import annotations

from collections.abc import Mapping

from memmlp.common.processes import MIN_CORE_SHARE
from memmlp.sweep.definition import TIMES
from memmlp.tables.measured_run import CORE_SHARES, Measured


def core_share(run: Measured) -> float | None:
    """Return the least share of a run's measured times in which the thread had a core; None if unknown."""
    return min((run.costs[name] for name in CORE_SHARES if name in run.costs), default=None)


def undisturbed(runs: Mapping[int, Measured]) -> Mapping[int, Measured]:
    """Return the runs whose thread had a core while it was timed; all of them if none is known to have.

    A time does not depend on the seed, so that one undisturbed measurement says more than a mean with others.
    """
    alone = {seed: run for seed, run in runs.items() if (core_share(run) or 0) >= MIN_CORE_SHARE}
    return alone or runs


def measured_for(metric: str, runs: Mapping[int, Measured]) -> Mapping[int, Measured]:
    """Return the runs whose values of a metric count: of a time the undisturbed ones, else every run."""
    return undisturbed(runs) if metric in TIMES else runs
