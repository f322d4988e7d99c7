"""Runs that one sweep's kept results share with another sweep.

It lies in config because planning a sweep composes its configs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from memmlp.config.plan_sweep import find_sweep, make_plan

if TYPE_CHECKING:
    from memmlp.report.kept_results import Kept
    from memmlp.sweep.plan import Plan
    from memmlp.tables.effects import RunsBySeed
    from memmlp.tables.measured_run import Measured


def with_kept(
    found: Mapping[str, RunsBySeed], plan: Plan, files: Iterable[Path]
) -> tuple[Mapping[str, RunsBySeed], tuple[str, ...]]:
    """Return a sweep's runs with those added that are kept in files of other sweeps' results.

    A kept run stands for an entry only if its file's sweep, planned today, has the same run with the same
    evaluations and deployment there: their identities hold all that its numbers follow from.

    Args:
        found: the sweep's own finished runs by the arm's label and the seed.
        plan: the plan of its runs.
        files: files of kept results.

    Returns:
        the runs, and the names of the files that some were taken from.

    Raises:
        InputError: where a file holds no results, or its sweep can't be planned.
    """
    from memmlp.report.kept_results import load_kept

    missing = [entry for entry in plan.entries if entry.seed not in found.get(entry.label, {})]
    merged: dict[str, dict[int, Measured]] = {label: dict(runs) for label, runs in found.items()}
    taken: list[str] = []
    for path in files:
        kept = load_kept(path)
        if not {run.id for run in kept.every} & {entry.id for entry in missing}:
            continue
        known = _by_key(kept, plan.outputs)
        for entry in missing:
            runs = merged.setdefault(entry.label, {})
            if entry.key in known and entry.seed not in runs:
                runs[entry.seed] = known[entry.key]
                taken.append(path.stem)
    return merged, tuple(dict.fromkeys(taken))


def _by_key(kept: Kept, outputs: Path) -> dict[str, Measured]:
    """Return the kept runs that their sweep has today, by the keys of the plan's entries."""
    seeds = sorted({seed for runs in kept.runs.values() for seed in runs})
    sweep = find_sweep(kept.sweep, [*kept.overrides, f"seed={','.join(map(str, seeds))}"])
    kept_runs = [
        (entry, kept.runs.get(entry.label, {}).get(entry.seed)) for entry in make_plan(sweep, outputs).entries
    ]
    return {entry.key: run for entry, run in kept_runs if run is not None and run.id == entry.id}
