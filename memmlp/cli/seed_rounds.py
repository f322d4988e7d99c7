"""Rounds of seeds on the command line (`--until-decided`): their checks, runs, looks and words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.shown_seeds import difference, rounds_path
from memmlp.common.errors import InputError

if TYPE_CHECKING:
    from memmlp.sweep.definition import Sweep
    from memmlp.sweep.plan import Plan
    from memmlp.tables.effects import RunsBySeed
    from memmlp.tables.seed_rounds import Look, Rounds


def current_rounds(sweep: Sweep, outputs: Path, most: int | None) -> Rounds:
    """Return the rounds of a sweep so far; new ones if no look was taken yet.

    Args:
        sweep: the sweep as it is now.
        outputs: the folder of runs and caches.
        most: the largest number of seeds of a variant (--max-seeds); None for that of the kept rounds, or the
            default.

    Raises:
        InputError: if looks were taken of a sweep that has changed since, or with another maximum.
    """
    from memmlp.tables.seed_rounds import MOST, new_rounds
    from memmlp.tables.seed_rounds_file import read

    path = rounds_path(sweep, outputs)
    kept = read(path)
    if kept is None or not kept.taken:
        return new_rounds(sweep, most or MOST)
    wanted = new_rounds(sweep, most or len(kept.seeds))
    if len(wanted.seeds) != len(kept.seeds):
        raise InputError(f"--max-seeds {most}: the looks of {path} are of up to {len(kept.seeds)} seeds")
    if other := difference(kept, wanted):
        raise InputError(f"{path}: its looks were taken with other {other}; remove it to begin anew")
    return kept


def check(overrides: Sequence[str], wanted: bool, most: int | None) -> None:
    """Raise InputError for options of the command line that don't go together."""
    if most is None and not wanted:
        return
    from memmlp.tables.seed_rounds import MOST
    from memmlp.tables.statistics import looks

    if most is not None and not wanted:
        raise InputError("--max-seeds: goes with --until-decided")
    if most is not None and most < (first := looks(MOST)[0]):
        raise InputError(f"--max-seeds {most}: allowed is at least {first}, the seeds of the first look")
    for word in overrides:
        if wanted and word.startswith("seed="):
            raise InputError(f"{word}: not with --until-decided, which takes the file's seeds and goes on")


def run_until_decided(
    sweep: Sweep, outputs: Path, rounds: Rounds, work: Callable[[Sweep, Plan], None], fail_fast: bool
) -> tuple[Rounds, Plan]:
    """Take look after look until none can be taken, and return the last rounds and plan.

    Args:
        sweep: the sweep with which the rounds began.
        outputs: the folder of runs and caches.
        rounds: the rounds so far.
        work: finishes the runs of a sweep's plan.
        fail_fast: whether the first failed run ends the rounds.
    """
    from dataclasses import replace

    from memmlp.config.compose_plan import kept_or_new_plan
    from memmlp.tables.seed_rounds_file import same_runs

    while True:
        spent = rounds.spent(sweep)
        plan = replace(kept_or_new_plan(spent, outputs, prepare=True), fail_fast=fail_fast)
        same_runs(rounds, sweep, plan, rounds_path(sweep, outputs))
        if plan.left():
            work(spent, plan)
        if plan.stopped:
            return rounds, plan
        after = look(sweep, outputs, rounds, plan)
        if after == rounds:
            return rounds, plan
        rounds = after
        click.echo("\n".join(progress_lines(rounds, sweep, rounds.taken[-1])))


def look(sweep: Sweep, outputs: Path, rounds: Rounds, plan: Plan) -> Rounds:
    """Take the next look that can be taken, record it, and return the rounds.

    If another process has taken a look in the meantime, its rounds are returned.
    """
    from memmlp.common.files import write_json
    from memmlp.common.lease import Lock
    from memmlp.tables.build_table import finished_runs
    from memmlp.tables.measured_run import load
    from memmlp.tables.runs_of_plan import run_finder
    from memmlp.tables.seed_rounds import advanced, as_json
    from memmlp.tables.seed_rounds_file import read

    path = rounds_path(sweep, outputs)
    with Lock(path.parent).hold():
        kept = read(path)
        if kept is not None and len(kept.taken) > len(rounds.taken):
            return kept
        runs: dict[str, RunsBySeed] = finished_runs(rounds.spent(sweep), run_finder(plan, load))
        after = advanced(rounds, sweep, runs, names(rounds, sweep, plan))
        write_json(path, as_json(after))
    return after


def names(rounds: Rounds, sweep: Sweep, plan: Plan) -> dict[str, str]:
    """Return, by label, a digest of the runs that each variant's next look will compare."""
    from memmlp.tables.seed_rounds_file import name_of

    looks = {label: rounds.looks[number] for label, number in rounds.next_looks(sweep).items()}
    return {label: name_of(rounds, sweep, plan, label, seeds) for label, seeds in looks.items()}


def schedule(rounds: Rounds) -> str:
    """Say at how many seeds there are looks, and what share of the 5 % each one spends."""
    words = [
        f"{seeds} ({100 * level:.2g} %)" for seeds, level in zip(rounds.looks, rounds.levels, strict=True)
    ]
    return f"looks at {', '.join(words)} seeds; together they spend 5 %"


def progress_lines(rounds: Rounds, sweep: Sweep, last: Look | None = None) -> list[str]:
    """Describe each variant's progress: its verdicts, seeds so far, and its next look."""
    from memmlp.tables.seed_rounds import standings

    variants = standings(rounds, sweep)
    decided = sum(variant.decided for variant in variants)
    head = f"look at {last.seeds} seeds ({100 * last.level:.2g} %): " if last else ""
    rows = [("variant", "decided", "inconclusive", "seeds", "next")]
    for variant in variants:
        following = f"look at {variant.next}" if variant.next else ""
        rows.append(
            (variant.label, str(variant.decided), str(variant.inconclusive), str(variant.seeds), following)
        )
    return [f"{head}{decided} of {len(rounds.family(sweep))} comparisons decided", *_lined(rows)]


def closing(rounds: Rounds, sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> list[str]:
    """Say why the rounds ended, what more seeds could do, and how many runs were spent."""
    latest = [finding for finding, _ in rounds.latest().values()]
    still = [finding for finding in latest if finding.verdict == "inconclusive"]
    evaluated = {mode for found in runs.values() for run in found.values() for mode in run.means}
    unseen = Counter(key.label for key in rounds.unseen(sweep) if key.mode in evaluated)
    lines = [] if still or unseen or rounds.next_looks(sweep) else ["all verdicts are decided"]
    lines += [
        f"of '{label}' {number} comparisons have no verdict: the runs have nothing to compare"
        for label, number in unseen.items()
    ]
    if any(finding.p is None for finding in still):
        lines.append("test clips are one group, or a network diverged on one: no number of seeds decides")
    return [*lines, *_outlooks(rounds, sweep, runs), _spent(rounds, sweep)]


def _outlooks(rounds: Rounds, sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> list[str]:
    """Return a line for each variant that has inconclusive comparisons and no next look."""
    from memmlp.tables.seed_rounds import outlook

    variants: dict[str, list[int | None]] = {}
    for key, number in outlook(rounds, sweep, runs).items():
        variants.setdefault(key.label, []).append(number)
    lines = []
    for label, numbers in variants.items():
        some = [number for number in numbers if number is not None]
        words = [f"{len(some)} would take about {max(some)} seeds"] if some else []
        if len(some) < len(numbers):
            words.append(f"{len(numbers) - len(some)} no number of seeds: the groups of clips are too few")
        lines.append(f"inconclusive of '{label}', if its effects are as measured: {'; '.join(words)}")
    return lines


def _spent(rounds: Rounds, sweep: Sweep) -> str:
    """Say how many runs were spent, and how many a fixed number of seeds would have taken."""
    used, variants = sum(rounds.counts(sweep).values()), len(sweep.runnable())
    last = max((look.seeds for look in rounds.taken), default=rounds.looks[0])
    fixed = [
        f"{variants * seeds} with {seeds} seeds for every variant"
        for seeds in sorted({last, rounds.looks[-1]})
    ]
    return f"{used} runs were spent; {', '.join(fixed)}"


def _lined(rows: Sequence[Sequence[str]]) -> list[str]:
    """Align rows of words in columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]
