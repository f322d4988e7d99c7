"""`memmlp sweep`: finish all runs of a table or a sweep file."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import add_run_options, config_dir_option, overrides_argument
from memmlp.cli.table import (
    SHOWN_MODES,
    ShownSweep,
    align_columns,
    flag_earlier_rounds,
    get_rounds_path,
    make_plan_table,
    print_tables,
    read_rounds,
)
from memmlp.cli.workers import Workers, add_worker_options, start_fleet
from memmlp.common.errors import InputError
from memmlp.common.files import write_json
from memmlp.common.lease import Lock
from memmlp.common.text_formats import join_command, make_console
from memmlp.config.compose_plan import find_sweep, get_sweep_folder, make_plan
from memmlp.config.plugins import format_config_dir
from memmlp.runs.identity import NETWORK
from memmlp.runs.lookup import format_outputs_option
from memmlp.sweep.definition import Sweep
from memmlp.sweep.plan import FAULTY, Plan, estimate_time

if TYPE_CHECKING:
    from memmlp.report.tables.seed_rounds import Analysis, Rounds


@click.command("sweep")
@click.argument("name")
@overrides_argument
@click.option(
    "--variant",
    "variants",
    metavar="LABEL",
    multiple=True,
    help="Run only this variant and its prerequisites; repeatable.",
)
@add_worker_options
@click.option("--status", is_flag=True, help="Only show the sweep's progress.")
@click.option(
    "--dry-run",
    is_flag=True,
    help="Only show the missing runs, and the expected time if data and finished runs exist.",
)
@click.option("--retry", is_flag=True, help="Repeat failed runs.")
@click.option("--again", is_flag=True, help="Train the sweep's networks again, without their prerequisites.")
@click.option("--until-decided", is_flag=True, help="Add seeds to variants with inconclusive verdicts.")
@click.option(
    "--max-seeds", type=int, help="Maximum number of seeds per variant, with --until-decided.  [default: 13]"
)
@config_dir_option
@add_run_options
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
    """Run the missing runs of a sweep.

    NAME is the path of a sweep file, a shipped sweep, or the number of a table. OVERRIDES are those of
    `memmlp train`, for all variants; `seed=0,1` sets the seeds. By default, workers are processes that share
    this machine's GPUs. They can also be Slurm jobs (`executor=slurm slurm.partition=P slurm.time=10:00:00
    slurm.gpus=1`, or other options of sbatch).

    With --until-decided, all variants get three seeds first. Then variants with inconclusive verdicts, and
    their controls, get more seeds, up to --max-seeds.
    """
    check_rounds_options(overrides, until_decided, max_seeds)
    if again and (until_decided or status or dry_run):
        raise InputError("--again: cannot be combined with --until-decided, --status or --dry-run")
    if variants and until_decided:
        raise InputError("--variant: cannot be combined with --until-decided, which chooses the variants")
    chosen = find_sweep(name, overrides)
    labels = chosen.select_labels(variants)
    outputs = outputs.absolute()
    rounds = load_rounds(chosen, outputs, max_seeds) if until_decided else None
    seeded = rounds.restrict_sweep(chosen) if rounds else chosen
    plan = make_plan(seeded, outputs, prepare=not (status or dry_run))
    selected = plan.select_variants(labels)
    if status or dry_run:
        show(seeded, plan, labels)
        if rounds:
            analyses = zip(rounds.schedule, rounds.levels, strict=True)
            parts = ", ".join(f"{seeds} ({100 * level:.2g} %)" for seeds, level in analyses)
            click.echo(f"interim analyses at {parts} seeds, with a total error rate of 5 %")
            click.echo("\n".join(describe_progress(rounds, chosen)))
        if dry_run:
            show_forecast(seeded, selected, labels, workers, get_sweep_folder(chosen, outputs))
        return
    reset_runs(selected, retry, again)
    if rounds:
        rounds, plan = run_until_decided(chosen, outputs, rounds, workers)
        shown = ShownSweep(rounds.restrict_sweep(chosen), plan, rounds)
    else:
        if selected.list_remaining():
            run_workers(chosen, selected, workers)
        shown = ShownSweep(chosen, plan, None, flag_earlier_rounds(chosen, outputs))
    show_outcome(shown, [name, *overrides], chosen, labels)


def reset_runs(plan: Plan, failed: bool, networks: bool) -> None:
    """Reset a plan's failed runs, or all its started or finished networks, but not their prerequisites."""
    for task in plan.tasks if failed else ():
        plan.get_run(task).retry()
    started = [task for task in plan.tasks if networks and task.kind == NETWORK]
    for run in {task.id: plan.get_run(task) for task in started}.values():
        with run.lock():
            run.reset()


def run_workers(chosen: Sweep, plan: Plan, workers: Workers) -> None:
    from memmlp.sweep.controller import complete_plan
    from memmlp.sweep.progress_table import Board

    _, fleet = start_fleet(get_sweep_folder(chosen, plan.outputs), plan, workers, list_devices(plan))
    complete_plan(plan, fleet, Board())


def list_devices(plan: Plan) -> set[str]:
    return {task.config["device"] for task in plan.tasks}


def show(chosen: Sweep, plan: Plan, labels: Collection[str]) -> None:
    """Print the progress of these variants, and warnings about results of older code."""
    from memmlp.sweep.progress_table import render

    shown = plan.select_variants(labels)
    click.echo(f"overrides: {' '.join(chosen.command_line) or 'none'}")  # other overrides make another sweep
    if shown.entries:
        states = shown.read_states()
        make_console().print(render(shown, states))
        done = [(e.label, shown.get_run(e).manifest) for e in shown.entries if states[e.key] == "done"]
        if done:
            from memmlp.report.tables.flags import flag_older_code  # imports SciPy, which is slow

            for line in flag_older_code(
                (label, m.get("sources", {}), m.get("plugins", ())) for label, m in done
            ):
                click.echo(line)
    if count := count_unprepared_runs(chosen, shown, labels):
        click.echo(f"{count} runs need data that is not prepared yet; the sweep prepares it first")


def count_unprepared_runs(chosen: Sweep, plan: Plan, labels: Collection[str]) -> int:
    """Return the number of runs of these variants that the plan lacks because data is not prepared yet."""
    shown = [variant for variant in chosen.list_runnable() if variant.label in labels]
    return sum(len(chosen.get_seeds(variant)) for variant in shown) - len(plan.entries)


def show_forecast(chosen: Sweep, plan: Plan, labels: Collection[str], workers: Workers, folder: Path) -> None:
    """Print the expected time of the remaining runs, and the batch file for Slurm."""
    count = workers.count_workers(workers.make_gpu_shares(list_devices(plan)))
    left, later = plan.list_remaining(), count_unprepared_runs(chosen, plan, labels)
    besides = ", and VQ-VAEs that these runs need" if later else ""
    line = f"{len(left) + later} of {len(plan.tasks) + later} runs to do{besides}, {count} at once"
    if not later and (found := estimate_time(plan)):
        minutes = found.seconds / count / 60
        line += f": about {minutes:.0f} min, estimated from {found.finished} finished runs"
    click.echo(line)
    click.echo(workers.make_batch_script(folder), nl=False)


def show_outcome(shown: ShownSweep, arguments: Sequence[str], chosen: Sweep, labels: Collection[str]) -> None:
    """Print a table, failed runs and the next command. Exits with 1 if a run of the `labels` has failed."""
    from memmlp.report.tables.build_table import write_table

    plan, rounds = shown.plan, shown.rounds
    command = join_command(["memmlp", "sweep", *arguments, *format_config_dir()])
    states = plan.read_states()
    failed = [task for task in plan.select_variants(labels).tasks if states[task.key] in FAULTY]
    found = make_plan_table(shown, SHOWN_MODES["both"], command)
    write_table(found.table, get_sweep_folder(chosen, plan.outputs))
    print_tables([found.table])
    for line in describe_end(rounds, chosen) if rounds else ():
        click.echo(line)
    click.echo(f"{sum(state == 'done' for state in states.values())} of {len(states)} runs done")
    for task in failed:
        reason = plan.get_run(task).fault or "a prerequisite run failed"
        click.echo(f"failed: run {task.id}: {reason}", err=True)
    if failed:
        click.echo("repeat failed runs with --retry", err=True)
        raise SystemExit(1)
    click.echo(f"next: {join_command(['memmlp', 'report', *format_outputs_option(plan.outputs)])}")


def check_rounds_options(overrides: Sequence[str], until_decided: bool, max_seeds: int | None) -> None:
    if max_seeds is None and not until_decided:
        return  # avoids the slow import of SciPy
    from memmlp.report.tables.seed_rounds import MAX_SEEDS
    from memmlp.report.tables.statistics import make_schedule

    if not until_decided:
        raise InputError("--max-seeds: needs --until-decided")
    if max_seeds is not None and max_seeds < (first := make_schedule(MAX_SEEDS)[0]):
        raise InputError(
            f"--max-seeds {max_seeds}: must be at least {first}, the number of seeds of the first analysis"
        )
    for override in overrides:
        if override.startswith("seed="):
            raise InputError(f"{override}: cannot be combined with --until-decided, which chooses the seeds")


def load_rounds(sweep: Sweep, outputs: Path, max_seeds: int | None) -> Rounds:
    """Load the seed rounds of a sweep, or start new ones. `max_seeds` is the maximum number of seeds per
    variant; None for that of the saved rounds, or the default."""
    from memmlp.report.tables.seed_rounds import MAX_SEEDS, start_rounds

    path = get_rounds_path(sweep, outputs)
    if (kept := read_rounds(sweep, outputs)) is None:
        return start_rounds(sweep, max_seeds or MAX_SEEDS)
    wanted = start_rounds(sweep, max_seeds or len(kept.seeds))
    if len(wanted.seeds) != len(kept.seeds):
        raise InputError(f"--max-seeds {max_seeds}: must be {len(kept.seeds)}, as in the analyses in {path}")
    if other := kept.find_difference(wanted):
        raise InputError(
            f"{path}: the interim analyses in this file have other {other}; remove the file to restart them"
        )
    return kept


def run_until_decided(sweep: Sweep, outputs: Path, rounds: Rounds, workers: Workers) -> tuple[Rounds, Plan]:
    """Finish runs and repeat interim analyses until no further one is possible."""
    from memmlp.report.tables.seed_rounds import check_same_runs

    while True:
        spent = rounds.restrict_sweep(sweep)
        plan = make_plan(spent, outputs, prepare=True)
        check_same_runs(rounds, sweep, plan, get_rounds_path(sweep, outputs))
        if plan.list_remaining():
            run_workers(spent, plan, workers)
        after = analyse(sweep, outputs, rounds, plan)
        if after == rounds:
            return rounds, plan
        rounds = after
        click.echo("\n".join(describe_progress(rounds, sweep, rounds.analyses[-1])))


def analyse(sweep: Sweep, outputs: Path, rounds: Rounds, plan: Plan) -> Rounds:
    """Do and record the next possible interim analysis, unless another process has done it."""
    from memmlp.report.tables.build_table import find_finished_runs, make_run_finder
    from memmlp.report.tables.measured_run import load_measured_run
    from memmlp.report.tables.seed_rounds import digest_runs, do_next_analysis

    path = get_rounds_path(sweep, outputs)
    with Lock(path.parent).hold():
        kept = read_rounds(sweep, outputs)
        if kept and len(kept.analyses) > len(rounds.analyses):
            return kept
        finder = make_run_finder(plan, load_measured_run)
        runs = find_finished_runs(rounds.restrict_sweep(sweep), finder)
        digests = {
            label: digest_runs(rounds, sweep, plan, label, rounds.schedule[number])
            for label, number in rounds.find_next_analyses(sweep).items()
        }
        after = do_next_analysis(rounds, sweep, runs, digests)
        write_json(path, asdict(after))
    return after


def describe_progress(rounds: Rounds, sweep: Sweep, last: Analysis | None = None) -> list[str]:
    from memmlp.report.tables.seed_rounds import list_progress

    variants = list_progress(rounds, sweep)
    decided = sum(variant.decided for variant in variants)
    head = f"analysis at {last.seeds} seeds ({100 * last.level:.2g} %): " if last else ""
    rows = [("variant", "decided", "inconclusive", "seeds", "next")]
    for one in variants:
        next_analysis = f"at {one.next}" if one.next else ""
        rows.append((one.label, str(one.decided), str(one.inconclusive), str(one.seeds), next_analysis))
    count = f"{head}{decided} of {len(rounds.list_comparison_keys(sweep))} comparisons decided"
    return [count, *(line.rstrip() for line in align_columns(rows, left=len(rows[0])))]


def describe_end(rounds: Rounds, sweep: Sweep) -> list[str]:
    """Describe why the seed rounds ended, and the number of runs."""
    latest = [finding for finding, _ in rounds.find_latest().values()]
    still = [finding for finding in latest if finding.verdict == "inconclusive"]
    analysed = {label for one in rounds.analyses for label in one.runs}
    without = sorted(analysed - {finding.label for finding in latest})
    lines = [] if still or without or rounds.find_next_analyses(sweep) else ["all verdicts are decided"]
    if without:
        lines.append(f"no verdict, because there is nothing to compare: {', '.join(without)}")
    if any(finding.p is None for finding in still):
        lines.append("no number of seeds is enough: all test clips form one group, or a network diverged")
    used, variants = sum(rounds.count_seeds(sweep).values()), len(sweep.list_runnable())
    last = max((one.seeds for one in rounds.analyses), default=rounds.schedule[0])
    fixed = [
        f"{variants * seeds} with {seeds} seeds for every variant"
        for seeds in sorted({last, rounds.schedule[-1]})
    ]
    return [*lines, f"{used} runs were done; without interim analyses: {', '.join(fixed)}"]
