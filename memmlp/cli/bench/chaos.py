"""`memmlp bench chaos` and `chaos-tune`: sweeps and searches whose processes are killed at random.

They must end with the same results as undisturbed ones.
"""

from __future__ import annotations

import csv
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import fmean

import click
import yaml

from memmlp.common.files import file_digest
from memmlp.common.lease import Lock, is_alive
from memmlp.runs.identity import NETWORK
from memmlp.runs.lookup import list_runs
from memmlp.runs.run import Run

OVERRIDES = ["profile=tiny", "data.synth.minutes=1", "loggers=none", "threads=1"]
PAUSES = (0.5, 3.0)  # seconds between kills of a sweep's processes
LONG_PAUSES = (3.0, 9.0)  # of a search's, whose one controller has to start again in between

SEARCH_SHARE = 0.25  # of all kills
PATIENCE = 60.0  # seconds for the last workers to let go of their runs

ENDS = ("complete", "pruned")  # how a trial may end whose runs can't fail

Launch = Callable[[], subprocess.Popen[bytes]]


@click.command("chaos")
@click.option(
    "--runs", default=12, show_default=True, help="How many runs the sweep has, of two arms with seeds."
)
@click.option(
    "--kills",
    default=20,
    show_default=True,
    help="How many times a worker or a controller is killed (SIGKILL).",
)
@click.option(
    "--controllers",
    default=3,
    show_default=True,
    help="How many memmlp sweep processes work at the same time.",
)
@click.option(
    "--trials",
    default=10,
    show_default=True,
    help="How many trials the search has that follows, with a quarter of the kills; 0 for no search.",
)
@click.option(
    "--seed", default=0, show_default=True, help="Seed of the random choice of what is killed, and when."
)
@click.argument("overrides", nargs=-1)
def chaos(
    runs: int, kills: int, controllers: int, trials: int, seed: int, overrides: tuple[str, ...]
) -> None:
    """Run a sweep, then a search, under random SIGKILLs.

    Several controllers work on each. The sweep is compared with an undisturbed one: every run must be
    finished exactly once, with bit-identical weights. The search must end with exactly the trials it should
    have, none repeated, none lost. Exits with 1 otherwise.
    """
    of_search = round(SEARCH_SHARE * kills) if trials else 0
    dice = random.Random(seed)
    problems = sweep_storm(runs, kills - of_search, controllers, dice, overrides)
    if trials:
        problems += search_storm(trials, of_search, controllers, dice, overrides)
    judge(problems, f"{kills} kills: as undisturbed")


def sweep_storm(
    runs: int, kills: int, controllers: int, dice: random.Random, overrides: Sequence[str]
) -> list[str]:
    """Run a sweep of two arms under kills, and list how it differs from an undisturbed one."""
    with tempfile.TemporaryDirectory() as folder:
        sweep = Path(folder) / "chaos.yaml"
        arms = {"vq": [], "none": ["memory=none"]}
        sweep.write_text(yaml.safe_dump({"variants": arms, "seeds": list(range((runs + 1) // 2))}))
        words = ["sweep", str(sweep), *OVERRIDES, *overrides]
        calm, stormy = Path(folder) / "calm", Path(folder) / "stormy"
        started = time.monotonic()
        assert start(words, calm, workers=2).wait() == 0, "the undisturbed sweep failed"
        click.echo(f"undisturbed: {time.monotonic() - started:.0f} s")
        started = time.monotonic()
        launch = partial(start, words, stormy, workers=1)
        killed = storm([launch] * controllers, stormy, kills, PAUSES, dice)
        click.echo(f"with {killed} kills: {time.monotonic() - started:.0f} s")
        return compare(calm, stormy)


@click.command("chaos-tune")
@click.option("--trials", default=10, show_default=True, help="How many trials the search has.")
@click.option(
    "--kills",
    default=8,
    show_default=True,
    help="How many times the controller or a worker is killed (SIGKILL).",
)
@click.option(
    "--seed", default=0, show_default=True, help="Seed of the random choice of what is killed, and when."
)
@click.argument("overrides", nargs=-1)
def chaos_tune(trials: int, kills: int, seed: int, overrides: tuple[str, ...]) -> None:
    """Run a search under random SIGKILLs.

    Its controller and workers are killed. It must end with exactly the trials it should have, none repeated,
    none lost. Exits with 1 otherwise.
    """
    problems = search_storm(trials, kills, 1, random.Random(seed), overrides)
    judge(problems, "all trials as they should be")


def search_storm(
    trials: int, kills: int, controllers: int, dice: random.Random, overrides: Sequence[str]
) -> list[str]:
    """Run a search under kills, and list what is wrong afterwards.

    One of several controllers directs the search; the others are refused, and started again until they
    succeed.
    """
    with tempfile.TemporaryDirectory() as folder:
        outputs = Path(folder) / "outputs"
        words = ["tune", *OVERRIDES, f"search.n_trials={trials}", "search.prune_after=3", *overrides]
        started = time.monotonic()
        launch = partial(start, words, outputs, workers=2)
        killed = storm([launch] * controllers, outputs, kills, LONG_PAUSES, dice)
        click.echo(f"{trials} trials with {killed} kills: {time.monotonic() - started:.0f} s")
        return examine(outputs, trials)


def judge(problems: Sequence[str], what: str) -> None:
    """Print the problems and a verdict; exit with 1 if there are problems."""
    for problem in problems:
        click.echo(problem)
    click.echo(f"{'' if not problems else 'NOT '}{what}: {len(problems)} differences")
    if problems:
        raise SystemExit(1)


def start(words: Sequence[str], outputs: Path, workers: int) -> subprocess.Popen[bytes]:
    """Start a `memmlp` process that works on a sweep or search."""
    line = [sys.executable, "-c", "from memmlp.cli.main import main; main()", *words]
    line += ["--workers", str(workers), "--outputs", str(outputs)]
    return subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def storm(
    launches: Sequence[Launch], outputs: Path, kills: int, pauses: tuple[float, float], dice: random.Random
) -> int:
    """Keep the processes running until all have ended well, and kill random ones meanwhile.

    A process that was killed, or that ended before all kills were made, is started again. Where all have
    ended before anything could be killed, the next pause is half as long: when their work is done they live
    shorter than any pause was meant for.

    Returns:
        The number of kills.
    """
    processes = [launch() for launch in launches]
    killed, share = 0, 1.0
    while killed < kills or any(process.poll() != 0 for process in processes):
        time.sleep(share * dice.uniform(*pauses))
        if killed < kills:
            victim = choose(processes, outputs, dice)
            share = share / 2 if victim is None else 1.0
            if victim is not None:
                os.kill(victim, signal.SIGKILL)
                killed += 1
        for index, launch in enumerate(launches):
            code = processes[index].poll()
            if code not in (None, 0) or (code == 0 and killed < kills):
                processes[index] = launch()
    await_release(outputs)
    return killed


def await_release(outputs: Path) -> None:
    """Wait, for a limited time, until workers whose controllers have ended have released their runs."""
    end = time.monotonic() + PATIENCE
    while any(Lock(folder).held for folder in outputs.glob("runs/*/")) and time.monotonic() < end:
        time.sleep(0.1)


def choose(processes: Sequence[subprocess.Popen[bytes]], outputs: Path, dice: random.Random) -> int | None:
    """Choose a process to kill: a controller, or a worker that holds a run; None if there is none."""
    owners = [Lock(folder).owner for folder in sorted(outputs.glob("runs/*/"))]
    workers = [int(owner["pid"]) for owner in owners if owner and is_alive(owner)]
    victims = [*(process.pid for process in processes if process.poll() is None), *workers]
    return dice.choice(victims) if victims else None


def compare(calm: Path, stormy: Path) -> list[str]:
    """List what is wrong in the disturbed sweep's outputs."""
    expected, found = ({run.id: run for run in list_runs(outputs)} for outputs in (calm, stormy))
    problems = [f"run {name} is missing" for name in expected.keys() - found.keys()]
    problems += [f"run {name} should not be" for name in found.keys() - expected.keys()]
    for name in sorted(expected.keys() & found.keys()):
        run = found[name]
        problems += [f"run {name}: {problem}" for problem in check(run.folder)]
        if run.done and file_digest(run.model) != file_digest(expected[name].model):
            problems.append(f"run {name}: other weights")
    return problems


def check(folder: Path) -> list[str]:
    """List what is wrong with a run that should have been finished exactly once."""
    run = Run(folder)
    if run.status != "done":
        return [f"{run.status}, not done"]
    problems = [f"artifact {name} is missing or changed" for name in run.verify()]
    attempts = run.manifest["attempts"]
    begun = [attempt["started"] for attempt in attempts if attempt["stage"] == "training"]
    if max(begun) > run.manifest["finished"]:
        problems.append("begun again after it was finished")
    if Lock(folder).held:
        problems.append("is held still")
    return problems


def examine(outputs: Path, trials: int) -> list[str]:
    """List what is wrong with a search's trials and runs."""
    (folder,) = (outputs / "tune").iterdir()
    with open(folder / "trials.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    problems = [] if len(rows) == trials else [f"{len(rows)} trials, not {trials}"]
    problems += [f"trial {row['trial']}: {row['state']}" for row in rows if row["state"] not in ENDS]
    ids = Counter(name for row in rows for name in row["run"].split())
    problems += [f"run {name}: of {count} trials" for name, count in ids.items() if count > 1]
    runs = {run.id: run for run in list_runs(outputs) if run.manifest.get("kind") in (None, NETWORK)}
    problems += [f"run {name}: of no trial" for name in runs.keys() - ids.keys()]
    for row in rows:
        if row["state"] == "complete":
            problems += _examine(row, runs)
    return problems


def _examine(row: dict[str, str], runs: Mapping[str, Run]) -> list[str]:
    """List what is wrong with a complete trial."""
    names = row["run"].split()
    if missing := [name for name in names if name not in runs]:
        return [f"trial {row['trial']}: its run {name} is missing" for name in missing]
    own = [runs[name] for name in names]
    problems = [f"run {run.id}: {problem}" for run in own for problem in check(run.folder)]
    last = [[entry for entry in run.metrics() if entry.phase == "val"][-1] for run in own]
    if float(row["MPJPE"]) != fmean(entry.values["rotation MPJPE"] for entry in last):
        problems.append(f"trial {row['trial']}: not the mean of its runs")
    return problems
