"""Runs that one sweep's kept results share with another sweep.

It lies in config because planning a sweep composes its configs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from memmlp.common.errors import InputError
from memmlp.config.compose_plan import find_sweep, plan_anew
from memmlp.runs.recipe_versions import outdated

if TYPE_CHECKING:
    from memmlp.report.kept_results import Kept
    from memmlp.sweep.plan import Entry, Plan
    from memmlp.tables.effects import RunsBySeed
    from memmlp.tables.measured_run import Measured


class SharedRuns(NamedTuple):
    """A sweep's runs, including those from other sweeps' kept results.

    Attributes:
        runs: the runs by the arm's label and the seed.
        files: the names of the files from which some were taken.
        flags: what a reader has to know about these.
        skipped: a line for each file that could not be used, with the reason.
    """

    runs: Mapping[str, RunsBySeed]
    files: tuple[str, ...]
    flags: tuple[str, ...]
    skipped: tuple[str, ...]


def with_kept(found: Mapping[str, RunsBySeed], plan: Plan, files: Iterable[Path]) -> SharedRuns:
    """Return a sweep's runs, with runs added from files of other sweeps' kept results.

    A kept run is used for an entry only if its file's sweep, planned now, has the same run with the same
    evaluations and deployment, and none of its recipe versions has changed since. Changed defaults of an
    evaluation are not noticed if its recipe version is unchanged.

    Args:
        found: the sweep's own finished runs by the arm's label and the seed.
        plan: the plan of its runs.
        files: files of kept results.

    Raises:
        InputError: if a file has no results.
    """
    from memmlp.report.kept_results import load_kept

    runs: dict[str, dict[int, Measured]] = {label: dict(seeds) for label, seeds in found.items()}
    taken, flags, skipped = [], [], []
    for path in files:
        missing = [entry for entry in plan.entries if entry.seed not in runs.get(entry.label, {})]
        kept = load_kept(path)
        if not {run.id for run in kept.every} & {entry.id for entry in missing}:
            continue
        try:
            known = _by_key(kept, plan.outputs)
        except InputError as error:  # such as data that is not on this machine
            skipped.append(f"{path}: not used, as its sweep cannot be planned here: {error}")
            continue
        used = [entry for entry in missing if entry.key in known]
        for entry in used:
            runs.setdefault(entry.label, {})[entry.seed] = known[entry.key]
        taken += [path.stem] if used else []
        flags += [_of_rounds(path.stem, used)] if used and kept.rounds else []
    return SharedRuns(runs, tuple(taken), tuple(flags), tuple(skipped))


def _of_rounds(name: str, entries: Iterable[Entry]) -> str:
    """Say which arms had seeds spent in rounds, for which intervals of a fixed number of seeds don't hold."""
    labels = ", ".join(dict.fromkeys(f"'{entry.label}'" for entry in entries))
    return f"seeds of {labels} were spent in rounds of {name}, so that these verdicts do not keep the 5 %"


def _by_key(kept: Kept, outputs: Path) -> dict[str, Measured]:
    """Return those kept runs that their sweep has now, by the keys of the plan's entries."""
    seeds = sorted({seed for runs in kept.runs.values() for seed in runs})
    sweep = find_sweep(kept.sweep, [*kept.overrides, f"seed={','.join(map(str, seeds))}"])
    pairs = [
        (entry, kept.runs.get(entry.label, {}).get(entry.seed)) for entry in plan_anew(sweep, outputs).entries
    ]
    return {
        entry.key: run
        for entry, run in pairs
        if run is not None and run.id == entry.id and not outdated(run.origin.recipes)
    }
