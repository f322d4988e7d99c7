"""`memmlp bench chaos`: sweeps whose processes are killed at random end as undisturbed ones do."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import click
import yaml

from memmlp.files import file_digest
from memmlp.runs import list_runs

OVERRIDES = ["profile=tiny", "data.synth.minutes=1", "tracker=none", "threads=1"]


@click.command("chaos")
@click.option("--runs", default=12, show_default=True, help="Runs of the sweep, two arms with seeds.")
@click.option("--kills", default=20, show_default=True, help="SIGKILLs of workers and controllers.")
@click.option("--controllers", default=3, show_default=True, help="Concurrent memmlp sweep processes.")
@click.option("--seed", default=0, show_default=True, help="Of the killer.")
@click.argument("overrides", nargs=-1)
def chaos(runs: int, kills: int, controllers: int, seed: int, overrides: tuple[str, ...]) -> None:
    """A sweep by several controllers under random SIGKILLs, beside an undisturbed one.

    Every run must be finished exactly once, with bit-identical weights. Exits with 1 where one isn't.
    """
    with tempfile.TemporaryDirectory() as folder:
        sweep = Path(folder) / "chaos.yaml"
        arms = {"vq": [], "none": ["memory=none"]}
        sweep.write_text(yaml.safe_dump({"arms": arms, "seeds": list(range((runs + 1) // 2))}))
        words = [*OVERRIDES, *overrides]
        calm, stormy = Path(folder) / "calm", Path(folder) / "stormy"
        started = time.monotonic()
        assert start(sweep, calm, words, workers=2).wait() == 0, "the undisturbed sweep failed"
        click.echo(f"undisturbed: {time.monotonic() - started:.0f} s")
        started = time.monotonic()
        killed = storm(sweep, stormy, words, kills, controllers, random.Random(seed))
        click.echo(f"with {killed} kills: {time.monotonic() - started:.0f} s")
        problems = compare(calm, stormy)
    for problem in problems:
        click.echo(problem)
    click.echo(f"{'as' if not problems else 'NOT as'} undisturbed: {len(problems)} differences")
    if problems:
        raise SystemExit(1)


def start(sweep: Path, outputs: Path, words: Sequence[str], workers: int) -> subprocess.Popen[bytes]:
    """A `memmlp sweep` process."""
    line = [sys.executable, "-c", "from memmlp.cli.main import main; main()", "sweep", str(sweep), *words]
    line += ["--workers", str(workers), "--outputs", str(outputs)]
    return subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def storm(
    sweep: Path, outputs: Path, words: Sequence[str], kills: int, controllers: int, dice: random.Random
) -> int:
    """Bring the sweep to its end while killing; how many kills there were."""
    processes = [start(sweep, outputs, words, workers=1) for _ in range(controllers)]
    killed = 0
    while any(process.poll() is None for process in processes) or killed < kills:
        time.sleep(dice.uniform(0.5, 3.0))
        if killed < kills and (victim := choose(processes, outputs, dice)) is not None:
            os.kill(victim, signal.SIGKILL)
            killed += 1
        for index, process in enumerate(processes):
            finished = process.poll() == 0 and killed >= kills
            if process.poll() is not None and not finished and not all_done(outputs, killed >= kills):
                processes[index] = start(sweep, outputs, words, workers=1)
        if all_done(outputs, True) and all(process.poll() is not None for process in processes):
            break
    assert start(sweep, outputs, words, workers=1).wait() == 0, "the last call failed"
    return killed


def choose(processes: Sequence[subprocess.Popen[bytes]], outputs: Path, dice: random.Random) -> int | None:
    """The process number of a controller or of a worker that holds a run."""
    victims = [process.pid for process in processes if process.poll() is None]
    for holder in outputs.glob("runs/*/.holder"):
        try:
            victims.append(int(json.loads(holder.read_bytes())["pid"]))
        except (OSError, ValueError):
            continue
    victims = [pid for pid in victims if _exists(pid)]
    return dice.choice(victims) if victims else None


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except OSError:
        return False
    return True


def all_done(outputs: Path, strict: bool) -> bool:
    """Whether all runs that were begun are done; never before the killer has had enough."""
    runs = list_runs(outputs)
    return strict and bool(runs) and all(run.done for run in runs)


def compare(calm: Path, stormy: Path) -> list[str]:
    """What is not as it should be in the disturbed sweep's outputs."""
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
    """What is wrong with a run that should have been finished exactly once."""
    from memmlp.runs import Run

    run = Run(folder)
    if run.status != "done":
        return [f"{run.status}, not done"]
    problems = [f"artifact {name} is missing or changed" for name in run.verify()]
    begun = [attempt["started"] for attempt in run.manifest["attempts"]]
    if max(begun) > run.manifest["finished"]:
        problems.append("begun again after it was finished")
    if (folder / ".holder").exists():
        problems.append("a holder is left")
    return problems
