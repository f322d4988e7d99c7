"""The part of a sweep that a table shows: its own seeds, or those that rounds spent on it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from memmlp.common.errors import InputError

if TYPE_CHECKING:
    from memmlp.sweep.definition import Sweep
    from memmlp.sweep.plan import Plan
    from memmlp.tables.seed_rounds import Rounds


class ShownSweep(NamedTuple):
    """The part of a sweep that a table shows, if seeds may have been spent in rounds.

    Attributes:
        sweep: the sweep with the seeds that were spent.
        plan: the plan of its runs.
        rounds: the rounds that decided the verdicts; None if no rounds did.
        flags: what a reader has to know if rounds were taken of something else.
    """

    sweep: Sweep
    plan: Plan
    rounds: Rounds | None
    flags: tuple[str, ...] = ()


def shown_sweep(sweep: Sweep, overrides: Sequence[str], outputs: Path) -> ShownSweep:
    """Return the sweep with its rounds, if rounds were taken and fit the sweep's present form.

    Otherwise the sweep is shown with its own seeds; if rounds were taken, a flag says so.
    """
    from memmlp.config.compose_plan import kept_or_new_plan
    from memmlp.tables.seed_rounds_file import read, same_runs

    path = rounds_path(sweep, outputs)
    kept = read(path)
    if kept is None or not kept.taken:
        return ShownSweep(sweep, kept_or_new_plan(sweep, outputs), None)
    seeds_given = any(word.startswith("seed=") for word in overrides)
    if flag := flag_of_other_rounds(kept, sweep, seeds_given):
        return ShownSweep(sweep, kept_or_new_plan(sweep, outputs), None, (flag,))
    spent = kept.spent(sweep)
    plan = kept_or_new_plan(spent, outputs)
    try:
        same_runs(kept, sweep, plan, path)
    except InputError as error:
        return ShownSweep(spent, plan, None, (f"seeds were spent in rounds, but not of these runs: {error}",))
    return ShownSweep(spent, plan, kept)


def flag_of_other_rounds(kept: Rounds, sweep: Sweep, seeds_given: bool = False) -> str | None:
    """Return a flag if the sweep has changed since the kept looks were taken; else None.

    `seeds_given` says that the sweep's seeds were given on the command line.
    """
    from memmlp.tables.seed_rounds import new_rounds

    other = "seeds" if seeds_given else difference(kept, new_rounds(sweep, len(kept.seeds)))
    return (
        f"seeds were spent in rounds with other {other}: these verdicts do not keep the 5 %"
        if other
        else None
    )


def spent_before(sweep: Sweep, outputs: Path) -> tuple[str, ...]:
    """Return a flag for a table with a fixed number of seeds if rounds were taken of the sweep before."""
    from memmlp.tables.seed_rounds_file import read

    kept = read(rounds_path(sweep, outputs))
    if kept is None or not kept.taken:
        return ()
    return ("seeds were spent in rounds before; memmlp table has their verdicts, these do not keep the 5 %",)


def rounds_path(sweep: Sweep, outputs: Path) -> Path:
    """Return the file in which a sweep's rounds are kept."""
    from memmlp.config.compose_plan import sweep_folder
    from memmlp.tables.seed_rounds_file import NAME

    return sweep_folder(sweep, outputs) / NAME


def difference(kept: Rounds, wanted: Rounds) -> str | None:
    """Name in a word what differs between two rounds of a sweep; None if nothing does."""
    if kept.seeds != wanted.seeds:
        return "seeds"
    if (kept.looks, kept.levels) != (wanted.looks, wanted.levels):
        return "looks"
    return next((key for key, value in wanted.subject.items() if kept.subject.get(key) != value), None)
