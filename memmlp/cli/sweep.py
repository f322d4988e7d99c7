"""`memmlp sweep`: finish all runs of a table, or of a user's sweep file."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import config_dir_option, outputs_option, plugins_option
from memmlp.cli.workers import Workers, hire, worker_options
from memmlp.common.errors import InputError
from memmlp.runs.identity import NETWORK

if TYPE_CHECKING:
    from memmlp.cli.shown_seeds import ShownSweep
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
    help="Run this variant alone, with what it builds on; may be given again.",
)
@worker_options
@click.option("--status", is_flag=True, help="Show how far the sweep is, and run nothing.")
@click.option(
    "--dry-run", is_flag=True, help="Show what would be run and how long it may take, and run nothing."
)
@click.option("--retry", is_flag=True, help="Run again what failed before.")
@click.option(
    "--again", is_flag=True, help="Train the sweep's networks again, begun ones too; not what they build on."
)
@click.option("--fail-fast", is_flag=True, help="End the sweep with the first run that fails.")
@click.option(
    "--until-decided", is_flag=True, help="Add seeds in rounds, to variants whose verdicts are inconclusive."
)
@click.option(
    "--max-seeds", type=int, help="Most seeds that a variant may get, with --until-decided.  [default: 13]"
)
@click.option("--yes", is_flag=True, hidden=True)
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
    fail_fast: bool,
    until_decided: bool,
    max_seeds: int | None,
    yes: bool,
    outputs: Path,
) -> None:
    """Run what is missing of a sweep: NAME is a file's path, a shipped sweep, or a table's number.

    OVERRIDES are those of `memmlp train`, for all variants; `seed=0,1` sets the seeds. The workers are
    processes of this machine, which share out its GPUs, jobs of Slurm (`executor=slurm slurm.partition=P
    slurm.time=10:00:00 slurm.gpus=1`, and any option of sbatch), or tasks of Ray (`executor=ray
    ray.num_gpus=1`) or Dask (`executor=dask`).

    With --until-decided all variants get three seeds first. Then only those with open verdicts, and their
    controls, get more, up to --max-seeds.
    """
    from memmlp.cli import seed_rounds
    from memmlp.cli.shown_seeds import ShownSweep, spent_before
    from memmlp.config.compose_plan import find_sweep, kept_or_new_plan, sweep_folder

    seed_rounds.check(overrides, until_decided, max_seeds)
    if again and (until_decided or status or dry_run):
        raise InputError("--again: allowed is without --until-decided, --status and --dry-run")
    if variants and until_decided:
        raise InputError("--variant: allowed is without --until-decided, which chooses variants itself")
    chosen = find_sweep(name, overrides)
    labels = chosen.labels_of(variants)
    outputs = outputs.absolute()
    rounds = seed_rounds.current_rounds(chosen, outputs, max_seeds) if until_decided else None
    spent = rounds.spent(chosen) if rounds else chosen
    plan = kept_or_new_plan(spent, outputs, prepare=not (status or dry_run))
    wanted = plan.of_variants(labels)
    if status or dry_run:
        show(spent, plan, labels)
        if rounds:
            click.echo("\n".join([seed_rounds.schedule(rounds), *seed_rounds.progress_lines(rounds, chosen)]))
        if dry_run:
            show_forecast(spent, wanted, labels, workers.number(workers.shares(devices(wanted))))
            click.echo(workers.script(sweep_folder(chosen, outputs)) or "", nl=False)
        return
    if retry:
        for task in wanted.tasks:
            wanted.run_of(task).retry()
    if again:
        reset(wanted)
    work = partial(run_workers, workers=workers)
    if rounds:
        rounds, plan = seed_rounds.run_until_decided(chosen, outputs, rounds, work, fail_fast)
        show_outcome(ShownSweep(rounds.spent(chosen), plan, rounds), [name, *overrides], chosen, labels)
        return
    wanted = replace(wanted, fail_fast=fail_fast)
    if wanted.left():
        work(chosen, wanted)
    show_outcome(
        ShownSweep(chosen, replace(plan, fail_fast=fail_fast), None, spent_before(chosen, outputs)),
        [name, *overrides],
        chosen,
        labels,
    )


def reset(plan: Plan) -> None:
    """Remove the plan's networks, finished or begun, so that they are trained again; upstream runs stay."""
    for run in {task.id: plan.run_of(task) for task in plan.tasks if task.kind == NETWORK}.values():
        with run.lock():
            run.reset()


def run_workers(chosen: Sweep, plan: Plan, workers: Workers) -> None:
    """Start workers, and wait until they have done the plan's runs."""
    from memmlp.config.compose_plan import sweep_folder
    from memmlp.sweep.controller import oversee
    from memmlp.sweep.progress_table import Board

    _, fleet = hire(sweep_folder(chosen, plan.outputs), plan, workers, devices(plan))
    oversee(plan, fleet, Board())


def devices(plan: Plan) -> set[str]:
    """Return the values of the key `device` of the plan's runs."""
    return {task.config["device"] for task in plan.tasks}


def show(chosen: Sweep, plan: Plan, labels: Collection[str]) -> None:
    """Print the board once, what older code made, and runs left over from earlier versions of the file.

    Args:
        chosen: the sweep.
        plan: its plan.
        labels: the labels of the variants that are shown.
    """
    from rich.console import Console

    from memmlp.config.compose_plan import orphans
    from memmlp.sweep.progress_table import render
    from memmlp.tables.flags_of_code import older_code

    shown = plan.of_variants(labels)
    click.echo(f"overrides: {' '.join(chosen.command_line) or 'none'}")  # others are another sweep
    if shown.entries:
        states = shown.states()
        Console(highlight=False).print(render(shown, states))
        done = [(e.label, shown.run_of(e).manifest) for e in shown.entries if states[e.key] == "done"]
        for line in older_code((label, m.get("sources", {}), m.get("plugins", ())) for label, m in done):
            click.echo(line)
    if found := unprepared(chosen, shown, labels):
        click.echo(f"{found} runs: their data is not prepared yet; the sweep does that first")
    for entry in orphans(chosen, plan):
        click.echo(f"orphan: run {entry.id} was '{entry.label}' seed {entry.seed} in an earlier version")


def unprepared(chosen: Sweep, plan: Plan, labels: Collection[str]) -> int:
    """Return how many runs of these variants their plan lacks because their data is not prepared yet."""
    return sum(one.label in labels for one in chosen.variant_seeds()) - len(plan.entries)


def show_forecast(chosen: Sweep, plan: Plan, labels: Collection[str], workers: int) -> None:
    """Print how long the remaining runs may take.

    VQ-VAEs are counted only for runs whose data is prepared.
    """
    from memmlp.sweep.forecast import forecast

    left, later = plan.left(), unprepared(chosen, plan, labels)
    besides = ", and the VQ-VAEs that they need" if later else ""
    line = f"{len(left) + later} of {len(plan.tasks) + later} runs to do{besides}, {workers} at once"
    if not later and (found := forecast(plan)):
        line += (
            f": about {found.seconds / workers / 60:.0f} min, judged by its {found.finished} finished runs"
        )
        if found.unlike:
            line += (
                f" ({found.unlike} runs are of variants without a finished one, and judged by other variants)"
            )
    click.echo(line)


def show_outcome(shown: ShownSweep, words: Sequence[str], chosen: Sweep, labels: Collection[str]) -> None:
    """Print the table, finished and failed runs, and the next command.

    Exits with 1 if something failed that the variants with these labels need.
    """
    from memmlp.cli.loggers import show_in_loggers
    from memmlp.cli.seed_rounds import closing
    from memmlp.cli.table import SHOWN_MODES, on_screen, table_of_plan
    from memmlp.config import plugins
    from memmlp.config.compose_plan import orphans, sweep_folder
    from memmlp.tables.measured_run import load

    plan, rounds, words = shown.plan, shown.rounds, [*words, *plugins.config_dir_words()]
    states = plan.states()
    failed = [task for task in plan.of_variants(labels).tasks if states[task.key] in ("failed", "blocked")]
    command = " ".join(["memmlp sweep", *words])
    found = table_of_plan(shown, SHOWN_MODES["both"], command, load)
    show_in_loggers(plan, sweep_folder(chosen, plan.outputs), found.table)
    on_screen([found.table])
    for line in closing(rounds, chosen, found.runs) if rounds else ():
        click.echo(line)
    click.echo(f"{sum(state == 'done' for state in states.values())} of {len(states)} runs done")
    for entry in orphans(chosen, plan):
        click.echo(f"orphan: run {entry.id} was '{entry.label}' seed {entry.seed} in an earlier version")
    for task in failed:
        reason = plan.run_of(task).failure or "what it builds upon failed"
        click.echo(f"failed: run {task.id}: {reason}", err=True)
    if failed:
        click.echo("again with: --retry", err=True)
        raise SystemExit(1)
    click.echo(f"next: memmlp report {' '.join(words)}")
