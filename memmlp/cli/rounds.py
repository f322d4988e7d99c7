"""`memmlp sweep --until-decided`: rounds of seeds for the arms whose verdicts are open."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from memmlp.common.errors import InputError

if TYPE_CHECKING:
    from memmlp.sweep.plan import Plan
    from memmlp.sweep.spec import Sweep
    from memmlp.tables.effects import Runs
    from memmlp.tables.rounds import Look, Rounds


def record(sweep: Sweep, outputs: Path) -> Path:
    """The file where a sweep's rounds are kept."""
    from memmlp.config.plan import sweep_folder

    return sweep_folder(sweep, outputs) / "rounds.json"


def read(path: Path) -> Rounds | None:
    """The rounds of a file; None where there is none. Raises InputError where it is damaged."""
    from memmlp.tables.rounds import of_json

    try:
        return of_json(json.loads(path.read_bytes()))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: no record of rounds ({error}); remove it to begin anew") from None


def begun(sweep: Sweep, outputs: Path, most: int | None) -> Rounds:
    """The rounds of a sweep as far as they are, new ones where no look was taken.

    Raises InputError where looks were taken of something else than the sweep is now, or to another end.
    """
    from memmlp.tables.rounds import MOST, begin

    path = record(sweep, outputs)
    kept = read(path)
    if kept is None or not kept.taken:
        return begin(sweep, most or MOST)
    wanted = begin(sweep, most or len(kept.seeds))
    if len(wanted.seeds) != len(kept.seeds):
        raise InputError(f"--max-seeds {most}: the looks of {path} are of up to {len(kept.seeds)} seeds")
    if other := _difference(kept, wanted):
        raise InputError(f"{path}: its looks were taken with other {other}; remove it to begin anew")
    return kept


def check(overrides: Sequence[str], wanted: bool, most: int | None) -> None:
    """Refuse words that don't go together."""
    from memmlp.statistics import looks
    from memmlp.tables.rounds import MOST

    if most is not None and not wanted:
        raise InputError("--max-seeds: goes with --until-decided")
    if most is not None and most < (first := looks(MOST)[0]):
        raise InputError(f"--max-seeds {most}: allowed is at least {first}, the seeds of the first look")
    for word in overrides:
        if wanted and word.startswith("seed="):
            raise InputError(f"{word}: not with --until-decided, which takes the file's seeds and goes on")


def until_decided(
    sweep: Sweep, outputs: Path, rounds: Rounds, work: Callable[[Sweep, Plan], None], fail_fast: bool
) -> tuple[Rounds, Plan]:
    """Take look after look, the runs that the next one needs made by `work`, until none can be taken."""
    from dataclasses import replace

    from memmlp.config.plan import planned

    while True:
        spent = rounds.spent(sweep)
        plan = replace(planned(spent, outputs, prepare=True), fail_fast=fail_fast)
        same_runs(rounds, sweep, plan, record(sweep, outputs))
        if plan.left():
            work(spent, plan)
        if plan.stopped:
            return rounds, plan
        after = look(sweep, outputs, rounds, plan)
        if after == rounds:
            return rounds, plan
        rounds = after
        click.echo("\n".join(told(rounds, sweep, rounds.taken[-1])))


def look(sweep: Sweep, outputs: Path, rounds: Rounds, plan: Plan) -> Rounds:
    """Take the next look that can be taken, and record it. Another process may have done so before."""
    from filelock import FileLock

    from memmlp.common.files import write_json
    from memmlp.tables.collect import finished
    from memmlp.tables.measured import load
    from memmlp.tables.planned_runs import finder
    from memmlp.tables.rounds import advanced, as_json

    path = record(sweep, outputs)
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(path.with_name(".rounds.lock")):
        kept = read(path)
        if kept is not None and len(kept.taken) > len(rounds.taken):
            return kept
        runs: dict[str, Runs] = finished(rounds.spent(sweep), finder(plan, load))
        after = advanced(rounds, sweep, runs, names(rounds, sweep, plan))
        write_json(path, as_json(after))
    return after


def names(rounds: Rounds, sweep: Sweep, plan: Plan) -> dict[str, str]:
    """What tells the runs of each arm and its control up to the arm's next look."""
    ahead = rounds.next_looks(sweep)
    return {label: _name(rounds, sweep, plan, label, rounds.looks[number]) for label, number in ahead.items()}


def _name(rounds: Rounds, sweep: Sweep, plan: Plan, label: str, seeds: int) -> str:
    """A digest of the identities of an arm's and its control's first runs, and of what is shown of them."""
    from memmlp.config.plan import digest
    from memmlp.tables.rounds import pair_of

    keys = {(entry.label, entry.seed): entry.key for entry in plan.entries}
    cells = [keys.get((one, seed)) for one in pair_of(sweep, label) for seed in rounds.seeds[:seeds]]
    return digest(cells)[:16]


def same_runs(rounds: Rounds, sweep: Sweep, plan: Plan, path: Path) -> None:
    """Raises InputError where a look was taken of other runs than the sweep's arms have now."""
    for taken in rounds.taken:
        for label, name in taken.runs.items():
            if name != _name(rounds, sweep, plan, label, taken.seeds):
                raise InputError(
                    f"{path}: its looks were taken of other runs of '{label}': data, configs or recipes "
                    "changed since; remove it to begin anew"
                )


def _difference(kept: Rounds, wanted: Rounds) -> str | None:
    """In what two rounds of a sweep differ, in a word."""
    if kept.seeds != wanted.seeds:
        return "seeds"
    if (kept.looks, kept.levels) != (wanted.looks, wanted.levels):
        return "looks"
    return next((key for key, value in wanted.subject.items() if kept.subject.get(key) != value), None)


class Shown(NamedTuple):
    """What a table shows of a sweep whose seeds may have been spent in rounds.

    Attributes:
        sweep: with the seeds that were spent. plan: its runs. rounds: whose verdicts stand, if any do.
        flags: what a reader has to know where rounds were taken, but not of this.
    """

    sweep: Sweep
    plan: Plan
    rounds: Rounds | None
    flags: tuple[str, ...] = ()


def shown(sweep: Sweep, overrides: Sequence[str], outputs: Path) -> Shown:
    """The sweep with its rounds, where there were any and they are of what it is now."""
    from memmlp.config.plan import planned

    path = record(sweep, outputs)
    kept = read(path)
    if kept is None or not kept.taken:
        return Shown(sweep, planned(sweep, outputs), None)
    chosen = any(word.startswith("seed=") for word in overrides)
    if flag := of_another(kept, sweep, chosen):
        return Shown(sweep, planned(sweep, outputs), None, (flag,))
    spent = kept.spent(sweep)
    plan = planned(spent, outputs)
    try:
        same_runs(kept, sweep, plan, path)
    except InputError as error:
        return Shown(spent, plan, None, (f"seeds were spent in rounds, but not of these runs: {error}",))
    return Shown(spent, plan, kept)


def of_another(kept: Rounds, sweep: Sweep, chosen: bool = False) -> str | None:
    """The line about looks that were of something else than the sweep is now; None where they are of it.

    chosen: whether the sweep's seeds were chosen by hand.
    """
    from memmlp.tables.rounds import begin

    other = "seeds" if chosen else _difference(kept, begin(sweep, len(kept.seeds)))
    return (
        f"seeds were spent in rounds with other {other}: these verdicts do not keep the 5 %"
        if other
        else None
    )


def spent_before(sweep: Sweep, outputs: Path) -> tuple[str, ...]:
    """What a reader of verdicts of a fixed number of seeds has to know, where rounds were taken before."""
    kept = read(record(sweep, outputs))
    if kept is None or not kept.taken:
        return ()
    return ("seeds were spent in rounds before; memmlp table has their verdicts, these do not keep the 5 %",)


def schedule(rounds: Rounds) -> str:
    """The looks and what they spend."""
    words = [
        f"{seeds} ({100 * level:.2g} %)" for seeds, level in zip(rounds.looks, rounds.levels, strict=True)
    ]
    return f"looks at {', '.join(words)} seeds; together they spend 5 %"


def told(rounds: Rounds, sweep: Sweep, last: Look | None = None) -> list[str]:
    """How far the arms are: comparisons decided and open, seeds, and what comes next."""
    latest = rounds.latest()
    ahead, counts = rounds.next_looks(sweep), rounds.counts(sweep)
    tally: dict[str, Counter[str]] = {label: Counter() for label in counts}
    for finding, _ in latest.values():
        tally[finding.label]["open" if finding.verdict == "open" else "decided"] += 1
    decided = sum(one["decided"] for one in tally.values())
    head = f"look at {last.seeds} seeds ({100 * last.level:.2g} %): " if last else ""
    rows = [("arm", "decided", "open", "seeds", "next")]
    for label, one in tally.items():
        following = f"look at {rounds.looks[ahead[label]]}" if label in ahead else ""
        rows.append((label, str(one["decided"]), str(one["open"]), str(counts[label]), following))
    return [f"{head}{decided} of {len(rounds.family(sweep))} comparisons decided", *_lined(rows)]


def closing(rounds: Rounds, sweep: Sweep, runs: Mapping[str, Runs]) -> list[str]:
    """Why it ended, what more seeds could do, and how many runs it took."""
    latest = [finding for finding, _ in rounds.latest().values()]
    still = [finding for finding in latest if finding.verdict == "open"]
    unseen = Counter(key.label for key in rounds.unseen(sweep))
    lines = [] if still or unseen or rounds.next_looks(sweep) else ["all verdicts are decided"]
    lines += [
        f"of '{label}' {number} comparisons have no verdict: the runs have nothing to compare"
        for label, number in unseen.items()
    ]
    if any(finding.p is None for finding in still):
        lines.append("the test clips are one group: no number of seeds decides")
    return [*lines, *_outlooks(rounds, sweep, runs), _spent(rounds, sweep)]


def _outlooks(rounds: Rounds, sweep: Sweep, runs: Mapping[str, Runs]) -> list[str]:
    """A line for each arm that stays open."""
    from memmlp.tables.rounds import outlook

    arms: dict[str, list[int | None]] = {}
    for key, number in outlook(rounds, sweep, runs).items():
        arms.setdefault(key.label, []).append(number)
    lines = []
    for label, numbers in arms.items():
        some = [number for number in numbers if number is not None]
        words = [f"{len(some)} would take about {max(some)} seeds"] if some else []
        if len(some) < len(numbers):
            words.append(f"{len(numbers) - len(some)} no number of seeds: the groups of clips are too few")
        lines.append(f"open of '{label}', if its effects are as measured: {'; '.join(words)}")
    return lines


def _spent(rounds: Rounds, sweep: Sweep) -> str:
    """The runs that it took, beside those of all arms."""
    used, arms = sum(rounds.counts(sweep).values()), len(sweep.runnable())
    last = max((look.seeds for look in rounds.taken), default=rounds.looks[0])
    fixed = [f"{arms * seeds} with {seeds} seeds for every arm" for seeds in sorted({last, rounds.looks[-1]})]
    return f"{used} runs were spent; {', '.join(fixed)}"


def _lined(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows as columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]
