"""Kill a sweep's and a search's processes at random; the results must be those of undisturbed ones.

    python benchmarks/chaos.py --runs 12 --kills 20
    python benchmarks/chaos.py --during export --kills 40 --trials 0
    python benchmarks/chaos.py --stops 30 --trials 0

Exits with 1 where they differ. tests/kills runs the same with a few kills.
"""

import contextlib
import csv
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from statistics import fmean

import click
import yaml

from memmlp.common.files import file_digest
from memmlp.common.lease import Lock, is_alive
from memmlp.report.ui.server import Answers, RunsServer
from memmlp.runs.identity import NETWORK
from memmlp.runs.lookup import list_runs
from memmlp.runs.run import Run
from memmlp.sweep.plan import Plan

OVERRIDES = ["profile=tiny", "data.synth.minutes=1", "loggers=none", "threads=1"]
PAUSES = (0.5, 3.0)  # seconds between kills of a sweep's processes
LONG_PAUSES = (3.0, 9.0)  # between kills of a search's, where the one controller has to start again
SEARCH_SHARE = 0.25  # of all kills
PATIENCE = 60.0  # seconds for the last workers to release their runs
ENDS = ("complete", "pruned")  # the ends of trials whose runs can't fail

MOMENTS: dict[str, Callable[[Run], bool]] = {
    "anything": lambda run: True,
    "checkpoints": lambda run: run.checkpoint.exists() and not run.done,
    "evaluation": lambda run: run.activity == "evaluating",
    "export": lambda run: run.activity == "exporting",
}
"""When a run's process may be killed."""

Launch = Callable[[], subprocess.Popen[bytes]]


@click.command()
@click.option("--runs", default=12, show_default=True, help="Runs of the sweep, of two variants with seeds.")
@click.option("--kills", default=20, show_default=True, help="How often a process is killed (SIGKILL).")
@click.option("--controllers", default=3, show_default=True, help="How many controllers work at once.")
@click.option("--trials", default=10, show_default=True, help="Trials of the search; 0 for no search.")
@click.option(
    "--during",
    type=click.Choice(list(MOMENTS)),
    default="anything",
    help="Kill workers of a sweep only then.",
)
@click.option(
    "--stops", default=0, help="How often the page stops and retries a run meanwhile, and prioritises one."
)
@click.option("--seed", default=0, show_default=True, help="Seed of the choice of victims and pauses.")
@click.argument("overrides", nargs=-1)
def main(
    runs: int,
    kills: int,
    controllers: int,
    trials: int,
    during: str,
    stops: int,
    seed: int,
    overrides: tuple[str, ...],
) -> None:
    """Run a sweep, then a search, under random SIGKILLs.

    Every run must be finished exactly once, with bit-identical weights. The search must end with exactly the
    expected trials, none repeated, none lost.
    """
    of_search = round(SEARCH_SHARE * kills) if trials else 0
    dice = random.Random(seed)
    problems = sweep_storm(runs, kills - of_search, controllers, dice, overrides, during, stops)
    if trials:
        problems += search_storm(trials, of_search, controllers, dice, overrides)
    click.echo("\n".join([*problems, f"{kills} kills: {len(problems)} differences"]))
    raise SystemExit(bool(problems))


def sweep_storm(
    runs: int,
    kills: int,
    controllers: int,
    dice: random.Random,
    overrides: Sequence[str],
    during: str = "anything",
    stops: int = 0,
) -> list[str]:
    """Run a sweep of two variants under kills and stops, and list how it differs from an undisturbed one."""
    with tempfile.TemporaryDirectory() as folder:
        sweep = Path(folder) / "chaos.yaml"
        variants = {"vq": [], "none": ["memory=none"]}
        sweep.write_text(yaml.safe_dump({"variants": variants, "seeds": list(range((runs + 1) // 2))}))
        arguments = ["sweep", str(sweep), *OVERRIDES, *overrides]
        calm, stormy = Path(folder) / "calm", Path(folder) / "stormy"
        assert start(arguments, calm, workers=2).wait() == 0, "the undisturbed sweep failed"
        launches = [partial(start, arguments, stormy, workers=1)] * controllers
        with stop_and_retry(stormy, stops, dice) as left:
            storm(launches, stormy, kills, PAUSES, dice, during, left)
        return compare(calm, stormy)


@contextlib.contextmanager
def stop_and_retry(outputs: Path, stops: int, dice: random.Random) -> Iterator[Callable[[], int]]:
    """Stop runs by the page's server, one after another, and retry each; yield how many are left."""
    counts = Counter({"left": stops})
    with RunsServer(Answers(outputs, lambda *_: {}, 0.2), 0) as server:

        def work() -> None:
            idle = 0
            while counts["left"] > 0:
                time.sleep(dice.uniform(*PAUSES) / 3)
                prioritize_last(server, outputs, counts)
                runs = [Run(folder) for folder in outputs.glob("runs/*/")]
                unfinished = [
                    run for run in runs if run.activity or (run.checkpoint.exists() and not run.done)
                ]
                idle = 0 if unfinished or not runs else idle + 1
                if idle > PATIENCE / PAUSES[1]:  # the sweep has ended
                    counts["late"], counts["left"] = counts["left"], 0
                if unfinished:
                    run = dice.choice(unfinished)
                    stopped = change(server, run, "stop")
                    end = time.monotonic() + PATIENCE
                    while run.state(run.complete) not in ("stopped", "done") and time.monotonic() < end:
                        time.sleep(0.2)
                    if stopped:
                        counts["seen"] += run.state(run.complete) == "stopped"
                        counts["left"] -= change(server, run, "retry")
            print(f"{stops - counts['late']} stops, of which {counts['seen']} were obeyed before their retry")
            print(f"{counts['prioritized']} waiting runs prioritised, of which {counts['next']} were next")

        thread = threading.Thread(target=work)
        thread.start()
        yield lambda: counts["left"]
        thread.join()


def prioritize_last(server: RunsServer, outputs: Path, counts: Counter[str]) -> None:
    """Prioritise the last waiting run that needs no other run, and count whether a worker takes it next."""
    tasks = [task for path in outputs.glob("sweeps/*/plan.json") for task in Plan.load(path).tasks]

    def list_waiting() -> list[str]:
        return [task.id for task in tasks if not Lock(outputs / "runs" / task.id).list_claims()]

    waiting = list_waiting()
    free = [task.id for task in tasks if task.id in waiting and not task.prerequisite]
    if len(free) > 1 and change(server, Run.from_id(outputs, free[-1]), "prioritize"):
        end = time.monotonic() + PATIENCE
        while not (taken := {*waiting} - {*list_waiting()}) and time.monotonic() < end:
            time.sleep(0.02)
        counts["prioritized"] += bool(taken)
        counts["next"] += free[-1] in taken


def change(server: RunsServer, run: Run, action: str) -> bool:
    """Ask the page's server for a change of a run, like the page; return whether it was done."""
    headers = {"X-Memmlp-Token": server.change_token, "Content-Type": "application/json"}
    body = json.dumps({"action": action, "runs": [run.id]}).encode()
    request = urllib.request.Request(f"{server.url}api/change", body, headers)
    try:
        return urllib.request.urlopen(request).status == 200
    except urllib.error.HTTPError:  # it has finished meanwhile
        return False


def search_storm(
    trials: int, kills: int, controllers: int, dice: random.Random, overrides: Sequence[str]
) -> list[str]:
    """Run a search under kills, and list what is wrong afterwards.

    One of several controllers directs the search; the others are refused, and started again until they
    succeed.
    """
    with tempfile.TemporaryDirectory() as folder:
        outputs = Path(folder) / "outputs"
        arguments = ["tune", *OVERRIDES, f"search.n_trials={trials}", "search.prune_after=3", *overrides]
        launch = partial(start, arguments, outputs, workers=2)
        storm([launch] * controllers, outputs, kills, LONG_PAUSES, dice)
        return examine(outputs, trials)


def start(arguments: Sequence[str], outputs: Path, workers: int) -> subprocess.Popen[bytes]:
    line = [sys.executable, "-c", "from memmlp.cli.main import main; main()", *arguments]
    line += ["--workers", str(workers), "--outputs", str(outputs)]
    return subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def storm(
    launches: Sequence[Launch],
    outputs: Path,
    kills: int,
    pauses: tuple[float, float],
    dice: random.Random,
    during: str = "anything",
    left: Callable[[], int] = lambda: 0,
) -> None:
    """Keep the processes running until all have succeeded and no stops are `left`, and kill random ones.

    A process that was killed, or that ended before the last kill, is restarted. If all have ended before a
    kill, the next pause is half as long.
    """
    processes = [launch() for launch in launches]
    killed, factor, counts = 0, 1.0, Counter[Path]()
    while killed < kills or left() or any(process.poll() != 0 for process in processes):
        time.sleep(factor * dice.uniform(*pauses))
        if killed < kills:
            victims = list_victims(processes, outputs, during)
            least = [
                victim for victim in victims if counts[victim[0]] == min(counts[one] for one, _ in victims)
            ]
            factor = 1.0 if victims else factor / 2
            if victims:  # a run that dies ten times in a row at one place would count as failed
                folder, victim = dice.choice(least)
                os.kill(victim, signal.SIGKILL)
                counts[folder] += 1
                killed += 1
        for index, launch in enumerate(launches):
            code = processes[index].poll()
            if code not in (None, 0) or (code == 0 and (killed < kills or left())):
                processes[index] = launch()
    wait_for_release(outputs)


def wait_for_release(outputs: Path) -> None:
    """Wait until no process holds a run; a sweep or search may end a second before its last worker."""
    end = time.monotonic() + PATIENCE
    while any(Lock(folder).is_held for folder in outputs.glob("runs/*/")) and time.monotonic() < end:
        time.sleep(0.1)


def list_victims(
    processes: Sequence[subprocess.Popen[bytes]], outputs: Path, during: str
) -> list[tuple[Path, int]]:
    """List processes to kill: workers that hold a run at that moment, else also controllers."""
    runs = [Run(folder) for folder in sorted(outputs.glob("runs/*/"))]
    owners = [(run.folder, Lock(run.folder).owner) for run in runs if MOMENTS[during](run)]
    workers = [(folder, int(owner["pid"])) for folder, owner in owners if owner and is_alive(owner)]
    if during != "anything":
        return workers
    return [*((outputs, process.pid) for process in processes if process.poll() is None), *workers]


def compare(calm: Path, stormy: Path) -> list[str]:
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
    starts = [attempt["started"] for attempt in attempts if attempt["stage"] == "training"]
    if max(starts) > run.manifest["finished"]:
        problems.append("trained again after it was finished")
    if Lock(folder).is_held:
        problems.append("is still held")
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
    for row in (row for row in rows if row["state"] == "complete"):
        names = row["run"].split()
        if missing := [name for name in names if name not in runs]:
            problems += [f"trial {row['trial']}: its run {name} is missing" for name in missing]
            continue
        problems += [f"run {name}: {problem}" for name in names for problem in check(runs[name].folder)]
        last = [[entry for entry in runs[name].metrics() if entry.phase == "val"][-1] for name in names]
        if float(row["MPJPE"]) != fmean(entry.values["rotation MPJPE"] for entry in last):
            problems.append(f"trial {row['trial']}: not the mean of its runs")
    return problems


if __name__ == "__main__":
    main()
