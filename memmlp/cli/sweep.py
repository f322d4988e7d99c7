"""`memmlp sweep`: bring all runs of a table, or of a sweep file of one's own, to their end."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING
from uuid import uuid4

import click

from memmlp.cli.options import outputs_option
from memmlp.common.errors import InputError

if TYPE_CHECKING:
    from memmlp.cli.rounds import Shown
    from memmlp.sweep.controller import Fleet
    from memmlp.sweep.executors import Executor
    from memmlp.sweep.plan import Plan
    from memmlp.sweep.spec import Sweep

OPTIONS = ("partition", "time", "mem_gb", "cpus", "gpus", "account", "qos", "constraint", "setup")


@click.command("sweep")
@click.argument("name")
@click.argument("overrides", nargs=-1)
@click.option(
    "--workers",
    default=None,
    type=click.IntRange(1),
    help="How many workers run at once.  [default: one a core]",
)
@click.option("--status", is_flag=True, help="Show how far the sweep is, and run nothing.")
@click.option(
    "--dry-run", is_flag=True, help="Show what would be run and how long it may take, and run nothing."
)
@click.option("--retry", is_flag=True, help="Run again what failed before.")
@click.option("--again", is_flag=True, help="Train the sweep's finished networks again; their VQ-VAEs stay.")
@click.option("--fail-fast", is_flag=True, help="End the sweep with the first run that fails.")
@click.option(
    "--until-decided", is_flag=True, help="Add seeds in rounds, to arms whose verdicts are open alone."
)
@click.option(
    "--max-seeds", type=int, help="Most seeds that an arm may get, with --until-decided.  [default: 13]"
)
@click.option("--yes", is_flag=True, hidden=True)
@outputs_option
def sweep(
    name: str,
    overrides: tuple[str, ...],
    workers: int | None,
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

    OVERRIDES are those of `memmlp train`, for all arms; `seed=0,1` sets the seeds. The workers are processes
    of this machine, Slurm jobs (`executor=slurm slurm.partition=P slurm.time=MINUTES slurm.mem_gb=16
    slurm.cpus=4 slurm.gpus=1`) or tasks of Ray (`executor=ray`).

    With --until-decided all arms get three seeds first. Then only those with open verdicts, and their
    controls, get more, up to --max-seeds.
    """
    from memmlp.cli import rounds
    from memmlp.config.plan_sweep import find_sweep, planned, sweep_folder
    from memmlp.sweep.executors import sbatch

    engine, options, rest = split_executor(overrides)
    rounds.check(rest, until_decided, max_seeds)
    if again and (until_decided or status or dry_run):
        raise InputError("--again: allowed is without --until-decided, --status and --dry-run")
    count = workers or os.cpu_count() or 1
    chosen = find_sweep(name).with_overrides(rest)
    outputs = outputs.absolute()
    known = rounds.begun(chosen, outputs, max_seeds) if until_decided else None
    spent = known.spent(chosen) if known else chosen
    plan = planned(spent, outputs, prepare=not (status or dry_run))
    if status or dry_run:
        show(spent, plan)
        if known:
            click.echo("\n".join([rounds.schedule(known), *rounds.told(known, chosen)]))
        if dry_run:
            forecast(plan, count)
            if engine == "slurm":
                click.echo(sbatch(sweep_folder(chosen, outputs) / "workers" / "%j", options))
        return
    if retry:
        for task in plan.tasks:
            plan.run_of(task).retry()
    if again:
        reset(plan)
    work = partial(bring_to_end, engine=engine, options=options, workers=count)
    if known:
        known, plan = rounds.until_decided(chosen, outputs, known, work, fail_fast)
        report(rounds.Shown(known.spent(chosen), plan, known), [name, *rest], chosen)
        return
    plan = replace(plan, fail_fast=fail_fast)
    if plan.left():
        work(chosen, plan)
    report(rounds.Shown(chosen, plan, None, rounds.spent_before(chosen, outputs)), [name, *rest], chosen)


def reset(plan: Plan) -> None:
    """Remove what the plan's networks are so far, so that all of them are made again; VQ-VAEs stay."""
    for run in {task.id: plan.run_of(task) for task in plan.tasks if task.kind != "vqvae"}.values():
        with run.lock():
            run.reset()


def split_executor(words: tuple[str, ...]) -> tuple[str, dict[str, object], tuple[str, ...]]:
    """Split the words into the executor's name, submitit's parameters for its jobs, and Hydra's overrides.

    Raises:
        InputError: for an unknown executor or an unknown or misplaced slurm key.
    """
    engine, options, rest = "local", {}, []
    for word in words:
        key, _, value = word.partition("=")
        if key == "executor":
            engine = value
        elif key.startswith("slurm."):
            options[key.removeprefix("slurm.")] = value
        else:
            rest.append(word)
    if engine not in ("local", "slurm", "ray", "debug"):
        raise InputError(f"executor={engine}: allowed is local, slurm or ray")
    for key in options:
        if key not in OPTIONS:
            raise InputError(f"slurm.{key}: no such key; allowed here: {', '.join(OPTIONS)}")
    if options and engine != "slurm":
        raise InputError(f"slurm.{next(iter(options))}: goes with executor=slurm")
    return engine, slurm_options(options), tuple(rest)


def executor(engine: str, options: dict[str, object], folder: Path) -> Executor:
    """Return the executor of that name; its workers' logs lie in `folder`/workers."""
    from memmlp.sweep.executors import Ray, Submitit

    if engine == "ray":
        return Ray()
    return Submitit(engine, folder / "workers" / "%j", options)


def slurm_options(options: dict[str, str]) -> dict[str, object]:
    """Translate our slurm keys into submitit's parameters. Raises InputError for a number that is none."""
    numbers = {"time": "timeout_min", "mem_gb": "mem_gb", "cpus": "cpus_per_task", "gpus": "gpus_per_node"}
    words = {"account", "qos", "constraint", "partition"}
    found: dict[str, object] = {}
    for key, value in options.items():
        if key in numbers:
            if not value.isdecimal() or int(value) == 0:
                raise InputError(f"slurm.{key}={value}: allowed is a whole number above 0")
            found[numbers[key]] = int(value)
        elif key in words:
            found[key] = value
        else:
            found[key] = [value]
    return found


def bring_to_end(chosen: Sweep, plan: Plan, engine: str, options: dict[str, object], workers: int) -> None:
    """Start workers, wait until they have done the plan's runs, and show these as one group in tracking."""
    from memmlp.config.plan_sweep import sweep_folder
    from memmlp.sweep.board import Board
    from memmlp.sweep.controller import oversee

    _, fleet = hire(sweep_folder(chosen, plan.outputs), plan, engine, options, workers)
    oversee(plan, fleet, Board())
    show_in_mlflow(plan)


def hire(
    folder: Path, plan: Plan, engine: str, options: dict[str, object], workers: int
) -> tuple[Path, Fleet]:
    """Save the plan in a file of this process' own, and return that file with a fleet of workers for it.

    No worker is started yet. Other processes that work on the same sweep have files of their own, so that
    nobody changes the plan under this one's workers.

    Args:
        folder: the folder of the sweep or search, where the workers' logs lie too.
        plan: the plan to work on.
        engine: the executor's name.
        options: submitit's parameters.
        workers: how many workers at most.
    """
    from memmlp.config.perform_task import work, work_alone
    from memmlp.sweep.controller import Fleet
    from memmlp.sweep.worker import Presence

    own = folder / "controllers" / uuid4().hex
    path = own.with_suffix(".json")
    plan.save(path)
    presence = Presence(own.with_suffix(".process"))
    threads = max((os.cpu_count() or 1) // workers, 1) if engine == "local" else 0
    local = partial(work, str(path), threads, str(presence.path))
    task = local if engine == "local" else partial(work_alone, str(path))
    return path, Fleet(executor(engine, options, folder), task, workers, folder / "workers", presence)


def show_in_mlflow(plan: Plan) -> None:
    """Show the plan's finished runs as one group, where runs are tracked."""
    from omegaconf import OmegaConf

    from memmlp.config.build import build_tracking
    from memmlp.runs.mlflow_tracking import harmless

    labels = {entry.id: entry.label for entry in plan.entries if plan.complete(entry)}
    if labels:
        config = next(task.config for task in plan.tasks if task.id in labels)
        with harmless(f"sweep {plan.name}"):
            build_tracking(OmegaConf.create(dict(config))).group(plan.name, labels)


def show(chosen: Sweep, plan: Plan) -> None:
    """Print the board once, and the runs that earlier versions of the sweep file left behind."""
    from rich.console import Console

    from memmlp.config.plan_sweep import orphans
    from memmlp.sweep.board import render

    missing = len(chosen.arm_seeds()) - len(plan.entries)
    if plan.entries:
        Console(highlight=False).print(render(plan, plan.states()))
    if missing:
        click.echo(f"{missing} runs wait for their data to be prepared, which the sweep does first")
    for entry in orphans(chosen, plan):
        click.echo(f"orphan: run {entry.id} was '{entry.label}' seed {entry.seed} in an earlier version")


def forecast(plan: Plan, workers: int) -> None:
    """Print how long the remaining runs may take, judged by the plan's finished runs of the same kind."""
    left = plan.left()
    known = {kind: _seconds(plan, kind) for kind in {task.kind for task in left}}
    line = f"{len(left)} of {len(plan.tasks)} runs to do, {workers} at once"
    if left and all(known.values()):
        minutes = sum(fmean(known[task.kind]) for task in left) / workers / 60
        line += f": about {minutes:.0f} min, by {sum(map(len, known.values()))} finished runs of it"
    click.echo(line)


def _seconds(plan: Plan, kind: str) -> list[float]:
    """Return the seconds that each of the plan's finished runs of that kind took, all stages together."""
    runs = [plan.run_of(task) for task in plan.tasks if task.kind == kind]
    found = [run.manifest.get("seconds", 0) for run in runs if run.done]
    return [sum(seconds.values()) if isinstance(seconds, dict) else seconds for seconds in found]


def report(shown: Shown, words: Sequence[str], chosen: Sweep) -> None:
    """Print the table, what is done, what failed, and the next command.

    Exits with 1 where something failed.
    """
    from memmlp.cli.rounds import closing
    from memmlp.cli.table import SHOWN_MODES, of_plan, on_screen
    from memmlp.config.plan_sweep import orphans
    from memmlp.tables.measured_run import load

    plan, known = shown.plan, shown.rounds
    states = plan.states()
    failed = [task for task in plan.tasks if states[task.key] in ("failed", "blocked")]
    command = " ".join(["memmlp sweep", *words])
    found = of_plan(shown, SHOWN_MODES["both"], command, load)
    on_screen([found.table])
    for line in closing(known, chosen, found.runs) if known else ():
        click.echo(line)
    click.echo(f"{sum(state == 'done' for state in states.values())} of {len(states)} runs done")
    for entry in orphans(chosen, plan):
        click.echo(f"orphan: run {entry.id} was '{entry.label}' seed {entry.seed} in an earlier version")
    for task in failed:
        reason = plan.run_of(task).failure or "its VQ-VAE failed"
        click.echo(f"failed: run {task.id}: {reason}", err=True)
    if failed:
        click.echo("again with: --retry", err=True)
        raise SystemExit(1)
    click.echo(f"next: memmlp report {' '.join(words)}")
