"""`memmlp sweep`: finish all runs of a table, or of a user's sweep file."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import config_dir_option, outputs_option, plugins_option
from memmlp.cli.workers import Workers, start_fleet, worker_options
from memmlp.common.errors import InputError
from memmlp.runs.identity import NETWORK

if TYPE_CHECKING:
    from memmlp.cli.table import ShownSweep
    from memmlp.report.tables.effects import RunsBySeed
    from memmlp.report.tables.seed_rounds import Analysis, Rounds
    from memmlp.sweep.definition import Sweep
    from memmlp.sweep.plan import Plan


@click.command("sweep")
@click.argument("name")
@click.argument("overrides", nargs=-1)
@click.option(
    "--variant",
    "variants",
    metavar="LABEL",
    multiple=True,
    help="Run this variant alone, with its prerequisites; repeatable.",
)
@worker_options
@click.option("--status", is_flag=True, help="Show the sweep's progress, and run nothing.")
@click.option(
    "--dry-run", is_flag=True, help="Show what would be run and the expected time, and run nothing."
)
@click.option("--retry", is_flag=True, help="Run again what failed before.")
@click.option("--again", is_flag=True, help="Train the sweep's networks again, but not their prerequisites.")
@click.option("--until-decided", is_flag=True, help="Add seeds to variants with inconclusive verdicts.")
@click.option(
    "--max-seeds", type=int, help="Most seeds that a variant may get, with --until-decided.  [default: 13]"
)
@config_dir_option
@plugins_option
@outputs_option
def sweep(
    name: str,
    overrides: tuple[str, ...],
    variants: tuple[str, ...],
    workers: Workers,
    status: bool,
    dry_run: bool,
    retry: bool,
    again: bool,
    until_decided: bool,
    max_seeds: int | None,
    outputs: Path,
) -> None:
    """Run the missing runs of a sweep: NAME is a file's path, a shipped sweep, or a table's number.

    OVERRIDES are those of `memmlp train`, for all variants; `seed=0,1` sets the seeds. The workers are
    processes of this machine, which share its GPUs, jobs of Slurm (`executor=slurm slurm.partition=P
    slurm.time=10:00:00 slurm.gpus=1`, and any option of sbatch), or tasks of Ray (`executor=ray
    ray.num_gpus=1`) or Dask (`executor=dask`).

    With --until-decided all variants get three seeds first. Then only those with inconclusive verdicts, and
    their controls, get more, up to --max-seeds.
    """
    from memmlp.cli.table import ShownSweep, flag_of_earlier_rounds
    from memmlp.config.compose_plan import find_sweep, make_plan, sweep_folder

    check_rounds_options(overrides, until_decided, max_seeds)
    if again and (until_decided or status or dry_run):
        raise InputError("--again: does not go with --until-decided, --status and --dry-run")
    if variants and until_decided:
        raise InputError("--variant: does not go with --until-decided, which chooses variants itself")
    chosen = find_sweep(name, overrides)
    labels = chosen.labels_of(variants)
    outputs = outputs.absolute()
    rounds = current_rounds(chosen, outputs, max_seeds) if until_decided else None
    spent = rounds.restrict_sweep(chosen) if rounds else chosen
    plan = make_plan(spent, outputs, prepare=not (status or dry_run))
    wanted = plan.of_variants(labels)
    if status or dry_run:
        show(spent, plan, labels)
        if rounds:
            shares = zip(rounds.schedule, rounds.levels, strict=True)
            parts = ", ".join(f"{seeds} ({100 * level:.2g} %)" for seeds, level in shares)
            click.echo(f"interim analyses at {parts} seeds; together they spend 5 %")
            click.echo("\n".join(describe_progress(rounds, chosen)))
        if dry_run:
            show_forecast(spent, wanted, labels, workers, sweep_folder(chosen, outputs))
        return
    restart(wanted, retry, again)
    work = partial(run_workers, workers=workers)
    given = [name, *overrides]
    if rounds:
        rounds, plan = run_until_decided(chosen, outputs, rounds, work)
        show_outcome(ShownSweep(rounds.restrict_sweep(chosen), plan, rounds), given, chosen, labels)
        return
    if wanted.left():
        work(chosen, wanted)
    flags = flag_of_earlier_rounds(chosen, outputs)
    show_outcome(ShownSweep(chosen, plan, None, flags), given, chosen, labels)


def restart(plan: Plan, failed: bool, networks: bool) -> None:
    """Prepare a plan's runs to be done again: failed ones, or all networks, finished or started.

    Prerequisites of networks stay.
    """
    for task in plan.tasks if failed else ():
        plan.run_of(task).retry()
    started = [task for task in plan.tasks if networks and task.kind == NETWORK]
    for run in {task.id: plan.run_of(task) for task in started}.values():
        with run.lock():
            run.reset()


def run_workers(chosen: Sweep, plan: Plan, workers: Workers) -> None:
    """Start workers, and wait until they have done the plan's runs."""
    from memmlp.config.compose_plan import sweep_folder
    from memmlp.sweep.controller import oversee
    from memmlp.sweep.progress_table import Board

    _, fleet = start_fleet(sweep_folder(chosen, plan.outputs), plan, workers, devices(plan))
    oversee(plan, fleet, Board())


def devices(plan: Plan) -> set[str]:
    """Return the values of the key `device` of the plan's runs."""
    return {task.config["device"] for task in plan.tasks}


def show(chosen: Sweep, plan: Plan, labels: Collection[str]) -> None:
    """Print the board once, and results of older code.

    Args:
        chosen: the sweep.
        plan: its plan.
        labels: the labels of the variants that are shown.
    """
    from rich.console import Console

    from memmlp.sweep.progress_table import render

    shown = plan.of_variants(labels)
    click.echo(f"overrides: {' '.join(chosen.command_line) or 'none'}")  # others are another sweep
    if shown.entries:
        states = shown.states()
        Console(highlight=False).print(render(shown, states))
        done = [(e.label, shown.run_of(e).manifest) for e in shown.entries if states[e.key] == "done"]
        if done:
            from memmlp.report.tables.flags import flag_older_code  # it imports SciPy

            for line in flag_older_code(
                (label, m.get("sources", {}), m.get("plugins", ())) for label, m in done
            ):
                click.echo(line)
    if count := count_unprepared(chosen, shown, labels):
        click.echo(f"{count} runs: their data is not prepared yet; the sweep does that first")


def count_unprepared(chosen: Sweep, plan: Plan, labels: Collection[str]) -> int:
    """Return how many runs of these variants their plan lacks because their data is not prepared yet."""
    return sum(one.label in labels for one in chosen.variant_seeds()) - len(plan.entries)


def show_forecast(chosen: Sweep, plan: Plan, labels: Collection[str], workers: Workers, folder: Path) -> None:
    """Print how long the remaining runs may take, and the file that sbatch would get.

    VQ-VAEs are counted only for runs whose data is prepared.
    """
    from memmlp.sweep.plan import forecast

    count = workers.number(workers.shares(devices(plan)))
    left, later = plan.left(), count_unprepared(chosen, plan, labels)
    besides = ", and the VQ-VAEs that they need" if later else ""
    line = f"{len(left) + later} of {len(plan.tasks) + later} runs to do{besides}, {count} at once"
    if not later and (found := forecast(plan)):
        minutes = found.seconds / count / 60
        line += f": about {minutes:.0f} min, estimated from {found.finished} finished runs"
    click.echo(line)
    click.echo(workers.script(folder), nl=False)


def show_outcome(shown: ShownSweep, given: Sequence[str], chosen: Sweep, labels: Collection[str]) -> None:
    """Print the table, finished and failed runs, and the next command.

    Exits with 1 if something failed that the variants with these labels need.

    Args:
        shown: the part of the sweep that the table shows.
        given: the sweep's name and overrides, as they were given.
        chosen: the sweep.
        labels: the labels of the variants that were run.
    """
    from memmlp.cli.table import SHOWN_MODES, print_tables, table_of_plan
    from memmlp.config import plugins
    from memmlp.config.compose_plan import sweep_folder
    from memmlp.report.tables.build_table import write_table
    from memmlp.report.tables.measured_run import load_measured_run

    plan, rounds, command = shown.plan, shown.rounds, " ".join([*given, *plugins.config_dir_words()])
    states = plan.states()
    failed = [task for task in plan.of_variants(labels).tasks if states[task.key] in ("failed", "blocked")]
    found = table_of_plan(shown, SHOWN_MODES["both"], f"memmlp sweep {command}", load_measured_run)
    write_table(found.table, sweep_folder(chosen, plan.outputs))
    print_tables([found.table])
    for line in describe_end(rounds, chosen) if rounds else ():
        click.echo(line)
    click.echo(f"{sum(state == 'done' for state in states.values())} of {len(states)} runs done")
    for task in failed:
        reason = plan.run_of(task).failure or "a prerequisite run failed"
        click.echo(f"failed: run {task.id}: {reason}", err=True)
    if failed:
        click.echo("again with: --retry", err=True)
        raise SystemExit(1)
    click.echo("next: memmlp report")


def check_rounds_options(overrides: Sequence[str], wanted: bool, most: int | None) -> None:
    """Raise InputError for options of --until-decided that don't go together."""
    if most is None and not wanted:
        return  # SciPy takes long to import
    from memmlp.report.tables.seed_rounds import MAX_SEEDS
    from memmlp.report.tables.statistics import make_schedule

    if most is not None and not wanted:
        raise InputError("--max-seeds: needs --until-decided")
    if most is not None and most < (first := make_schedule(MAX_SEEDS)[0]):
        raise InputError(f"--max-seeds {most}: must be at least {first}, the seeds of the first analysis")
    for override in overrides:
        if wanted and override.startswith("seed="):
            raise InputError(f"{override}: does not go with --until-decided, which adds to the file's seeds")


def current_rounds(sweep: Sweep, outputs: Path, most: int | None) -> Rounds:
    """Return the rounds of a sweep so far; new ones if no interim analysis was done yet.

    Args:
        sweep: the sweep as it is now.
        outputs: the folder of runs and caches.
        most: the largest number of seeds of a variant (--max-seeds); None for that of the kept rounds, or the
            default.

    Raises:
        InputError: if the analyses were of a sweep that has changed since, or with another maximum.
    """
    from memmlp.cli.table import rounds_path
    from memmlp.report.tables.seed_rounds import MAX_SEEDS, Rounds, start_rounds

    path = rounds_path(sweep, outputs)
    kept = Rounds.read(path)
    if kept is None or not kept.analyses:
        return start_rounds(sweep, most or MAX_SEEDS)
    wanted = start_rounds(sweep, most or len(kept.seeds))
    if len(wanted.seeds) != len(kept.seeds):
        raise InputError(f"--max-seeds {most}: must be {len(kept.seeds)}, as in the rounds of {path}")
    if other := kept.find_difference(wanted):
        raise InputError(f"{path}: its interim analyses were of other {other}; remove it to restart them")
    return kept


def run_until_decided(
    sweep: Sweep, outputs: Path, rounds: Rounds, work: Callable[[Sweep, Plan], None]
) -> tuple[Rounds, Plan]:
    """Do one interim analysis after another until none can be done, and return the last rounds and plan.

    Args:
        sweep: the sweep with which the rounds began.
        outputs: the folder of runs and caches.
        rounds: the rounds so far.
        work: finishes the runs of a sweep's plan.
    """
    from memmlp.cli.table import rounds_path
    from memmlp.config.compose_plan import make_plan
    from memmlp.report.tables.seed_rounds import check_same_runs

    while True:
        spent = rounds.restrict_sweep(sweep)
        plan = make_plan(spent, outputs, prepare=True)
        check_same_runs(rounds, sweep, plan, rounds_path(sweep, outputs))
        if plan.left():
            work(spent, plan)
        after = analyse(sweep, outputs, rounds, plan)
        if after == rounds:
            return rounds, plan
        rounds = after
        click.echo("\n".join(describe_progress(rounds, sweep, rounds.analyses[-1])))


def analyse(sweep: Sweep, outputs: Path, rounds: Rounds, plan: Plan) -> Rounds:
    """Do the next interim analysis that can be done, record it, and return the rounds.

    If another process has done one in the meantime, its rounds are returned.
    """
    from dataclasses import asdict

    from memmlp.cli.table import rounds_path
    from memmlp.common.files import write_json
    from memmlp.common.lease import Lock
    from memmlp.report.tables.build_table import find_finished_runs, make_run_finder
    from memmlp.report.tables.measured_run import load_measured_run
    from memmlp.report.tables.seed_rounds import Rounds, digest_runs, do_next_analysis

    path = rounds_path(sweep, outputs)
    with Lock(path.parent).hold():
        kept = Rounds.read(path)
        if kept is not None and len(kept.analyses) > len(rounds.analyses):
            return kept
        runs: dict[str, RunsBySeed] = find_finished_runs(
            rounds.restrict_sweep(sweep), make_run_finder(plan, load_measured_run)
        )
        digests = {
            label: digest_runs(rounds, sweep, plan, label, rounds.schedule[number])
            for label, number in rounds.find_next_analyses(sweep).items()
        }
        after = do_next_analysis(rounds, sweep, runs, digests)
        write_json(path, asdict(after))
    return after


def describe_progress(rounds: Rounds, sweep: Sweep, last: Analysis | None = None) -> list[str]:
    """Describe each variant's progress: its verdicts, its seeds so far, and its next interim analysis."""
    from memmlp.cli.table import aligned
    from memmlp.report.tables.seed_rounds import list_progress

    variants = list_progress(rounds, sweep)
    decided = sum(variant.decided for variant in variants)
    head = f"analysis at {last.seeds} seeds ({100 * last.level:.2g} %): " if last else ""
    rows = [("variant", "decided", "inconclusive", "seeds", "next")]
    for one in variants:
        following = f"at {one.next}" if one.next else ""
        rows.append((one.label, str(one.decided), str(one.inconclusive), str(one.seeds), following))
    count = f"{head}{decided} of {len(rounds.list_comparison_keys(sweep))} comparisons decided"
    return [count, *(line.rstrip() for line in aligned(rows, left=len(rows[0])))]


def describe_end(rounds: Rounds, sweep: Sweep) -> list[str]:
    """Say why the rounds ended, and how many runs were spent."""
    latest = [finding for finding, _ in rounds.find_latest().values()]
    still = [finding for finding in latest if finding.verdict == "inconclusive"]
    analysed = {label for one in rounds.analyses for label in one.runs}
    without = sorted(analysed - {finding.label for finding in latest})
    lines = [] if still or without or rounds.find_next_analyses(sweep) else ["all verdicts are decided"]
    if without:
        lines.append(f"no verdict, as the runs have nothing to compare: {', '.join(without)}")
    if any(finding.p is None for finding in still):
        lines.append("test clips are one group, or a network diverged on one: no number of seeds decides")
    used, variants = sum(rounds.count_seeds(sweep).values()), len(sweep.runnable())
    last = max((one.seeds for one in rounds.analyses), default=rounds.schedule[0])
    fixed = [
        f"{variants * seeds} with {seeds} seeds for every variant"
        for seeds in sorted({last, rounds.schedule[-1]})
    ]
    return [*lines, f"{used} runs were spent; {', '.join(fixed)}"]
