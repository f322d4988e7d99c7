"""`memmlp bench train`: how fast a changed recipe reaches the present recipe's final validation error."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from memmlp.cli.options import Finite, config_dir_option, plugins_option
from memmlp.evaluation.metric_facts import UNITS

if TYPE_CHECKING:
    from memmlp.pipeline.experiment import Experiment
    from memmlp.training.time_to_error import Learner, Validation

ERRORS = ("MPJRE", "MPJPE", "MPJVE", "Jitter")
ARMS = ("today", "recipe")
BASE = ("profile=small", "device=cpu", "loggers=none")
WARM_UP = 3  # steps of each that are taken before any is timed


@click.command("train")
@click.option("--recipe", default="", help="Overrides that make the recipe of today's, separated by spaces.")
@click.option("--seeds", default=5, show_default=True, type=click.IntRange(1), help="How many seeds, from 0.")
@click.option(
    "--error", default="MPJPE", show_default=True, type=click.Choice(ERRORS), help="Which error counts."
)
@click.option(
    "--every",
    default=50,
    show_default=True,
    type=click.IntRange(1),
    help="Steps between validations, after which the other training has its turn.",
)
@click.option(
    "--times",
    default=1.0,
    show_default=True,
    type=Finite(min=0, min_open=True),
    help="How many times sooner is claimed.",
)
@click.option(
    "--json",
    "file",
    type=click.Path(path_type=Path),
    help="File of what was measured, written after each seed; what it has already is not measured again.",
)
@click.option(
    "--breakdown",
    type=click.IntRange(1),
    metavar="STEPS",
    help="Show instead where the time of a step goes, over so many steps of each.",
)
@click.argument("overrides", nargs=-1)
@config_dir_option
@plugins_option
def train(
    recipe: str,
    seeds: int,
    error: str,
    every: int,
    times: float,
    file: Path | None,
    breakdown: int | None,
    overrides: tuple[str, ...],
) -> None:
    """Time a recipe of training beside today's.

    Today's recipe is `memmlp train` with OVERRIDES (by default profile=small); the recipe has the overrides
    of --recipe, too. For each seed both are trained on the CPU, in turn, piece by piece. Printed are when
    each first had the validation error (stream mode) that today's ends with, in steps and in seconds of the
    processor (of all threads, so no time of a clock) without validations, and the ratio of the seconds with
    an interval over seeds.
    """
    import os
    import shlex

    from memmlp.common.errors import InputError

    own = tuple(shlex.split(recipe))
    if any(word.lstrip("+").startswith("threads=") for word in own):
        raise InputError("--recipe threads: allowed is among OVERRIDES, which are of both arms")
    if breakdown:
        os.environ.setdefault(
            "KINETO_LOG_LEVEL", "99"
        )  # before torch is there, whose profiler talks on stderr
        for arm, words in zip(ARMS, ((), own), strict=True):
            if words or arm == ARMS[0]:
                show_breakdown(arm, (*BASE, *overrides, *words), breakdown)
        return
    subject = {"overrides": list(overrides), "recipe": list(own), "error": error, "every": every}
    arms = {
        seed: {
            arm: compose_experiment((*BASE, *overrides, *words, f"seed={seed}"))
            for arm, words in zip(ARMS, ((), own), strict=True)
        }
        for seed in range(seeds)
    }
    made_by = maker(arms[0])
    rows = known_rows(file, subject, made_by)
    for seed, experiments in arms.items():
        rows[seed] = measure_seed(experiments, seed, error, every, rows.get(seed))
        if seed == 0:
            click.echo(f"s: seconds {of_processor(made_by['threads'])}")
        click.echo(seed_line(rows[seed], error))
        if file:
            write(file, subject, made_by, rows, times)
    click.echo(conclusion(summary([rows[seed] for seed in range(seeds)], times), made_by["threads"]))


def of_processor(threads: int) -> str:
    """Return in words whose time is measured. Threads' times are added up, so they exceed a clock's."""
    return "of the processor" + (f", of all {threads} threads together" if threads > 1 else "")


def maker(experiments: dict[str, Experiment]) -> dict[str, Any]:
    """Return what the seconds of a row depend on beside its runs: threads, torch, processor, and code."""
    import torch

    from memmlp.runs.environment import code_digests, environment

    packages = {name for one in experiments.values() for name in one.config.get("plugins") or ()}
    return {
        "threads": torch.get_num_threads(),
        "torch": str(torch.__version__),
        "cpu": environment()["cpu"],
        "code": code_digests(sorted(packages)),
    }


def other_maker(before: dict[str, Any], now: dict[str, Any]) -> str:
    """Return in words how what measured some rows differs from what would go on; empty if it does not.

    Args:
        before: as `maker` returned it then; empty if it was not written down.
        now: as `maker` returns it.
    """
    from memmlp.runs.environment import changed
    from memmlp.tables.flag_words import listed

    if not before:
        return "code that it does not name"
    words = [
        f"{key} {before[key]} (here {now[key]})" for key in now if key != "code" and before[key] != now[key]
    ]
    files = changed(before["code"], now["code"])
    return ", ".join([*words, *([f"other code of {listed(files, 3)}"] if files else [])])


def known_rows(
    file: Path | None, subject: dict[str, Any], made_by: dict[str, Any]
) -> dict[int, dict[str, Any]]:
    """Return the rows that a file has already, by seed; empty if there is no file.

    Raises:
        InputError: if the file is from another comparison, its rows were made by other code, threads, torch
            or on another processor, or it can't be written.
    """
    from memmlp.common.errors import InputError
    from memmlp.common.files import read_json

    if file is None:
        return {}
    if not file.absolute().parent.is_dir():
        raise InputError(f"--json {file}: there is no folder {file.parent}")
    if not file.exists():
        return {}
    content = read_json(file)
    if content.get("subject") != subject:
        raise InputError(
            f"--json {file}: is of another comparison; allowed is a new file, or the same options"
        )
    if other := other_maker(content.get("made_by") or {}, made_by):
        raise InputError(f"--json {file}: its rows are of {other}; allowed is a new file, or what made them")
    return {row["seed"]: row for row in content["seeds"]}


def compose_experiment(words: Sequence[str]) -> Experiment:
    """Build the experiment for overrides, and set torch's number of threads to its.

    Raises:
        InputError: for bad overrides, and for a device other than the CPU.
    """
    import torch

    from memmlp.common.errors import InputError
    from memmlp.config.build import build_experiment
    from memmlp.config.compose import composed
    from memmlp.training.train_network import NetworkTraining

    experiment = build_experiment(composed(words))
    if experiment.device.type != "cpu":
        raise InputError(f"device={experiment.device}: allowed is cpu, whose time is measured")
    if not isinstance(experiment.training, NetworkTraining):
        raise InputError("refiner: bench train times a network's training; allowed is refiner=null")
    if threads := experiment.config["threads"]:
        torch.set_num_threads(threads)
    return experiment


def measure_seed(
    experiments: dict[str, Experiment], seed: int, error: str, every: int, known: dict[str, Any] | None
) -> dict[str, Any]:
    """Return the row of a seed: the error, when each arm reached it, and the ids of the arms' runs.

    Args:
        experiments: the experiments of both arms.
        seed: their seed.
        error: the error's name.
        every: steps between validations.
        known: the row that exists already.

    Raises:
        InputError: if the arms differ in something that is not timed, or the known row belongs to other runs.
    """
    from memmlp.common.errors import InputError

    data = {arm: experiment.motion.prepare() for arm, experiment in experiments.items()}
    runs = {arm: experiment.identity(data[arm].digest) for arm, experiment in experiments.items()}
    ids = {arm: run.id for arm, run in runs.items()}
    if known is not None:
        if known["runs"] != ids:
            raise InputError(
                "--json: what is measured there is of other configs, recipe versions or data; use a new file"
            )
        return known
    if len({(run.data, run.upstream.id if run.upstream else None) for run in runs.values()}) > 1:
        raise InputError(
            "--recipe: changes the data or the VQ-VAE; allowed is the network and how it is trained"
        )
    learners = {arm: learner(experiments[arm], data[arm], error) for arm in ARMS}
    reached, target = race(learners, every, f"seed {seed}")
    marks = {arm: one._asdict() if one else None for arm, one in reached.items()}
    return {"seed": seed, "runs": ids, "target": target, **marks}


def learner(experiment: Experiment, data: Any, error: str = "MPJPE") -> Learner:
    """Return an experiment's training, which can run piece by piece; its VQ-VAE is found or trained first."""
    from memmlp.pipeline.run_stages import make_upstream_runs
    from memmlp.training.time_to_error import Learner
    from memmlp.training.train_network import NetworkTraining

    training = experiment.training
    assert isinstance(training, NetworkTraining)
    training.optim.check_installed()
    above = make_upstream_runs(experiment, data)
    task = training.task(experiment.architecture, data, above.weights() if above else None, experiment.device)
    return Learner(task, training.optim, training.seed, f"rotation {error}")


def race(
    learners: dict[str, Learner], every: int, description: str
) -> tuple[dict[str, Validation | None], float]:
    """Train both learners in turn, and compare how soon they reach the present recipe's final error.

    Returns:
        The validation at which each learner first had at most that error, or None, and that error.
    """
    import math
    from collections import deque

    from memmlp.common.progress import progress_bar
    from memmlp.training.time_to_error import first_at, in_turn

    pieces = sum(math.ceil(one.optim.steps / every) for one in learners.values())
    turns = in_turn([learners[arm] for arm in reversed(ARMS)], every)  # today's is not on a cold start
    deque(progress_bar(turns, description, pieces), maxlen=0)
    target = learners[ARMS[0]].validations[-1].error
    return {arm: first_at(one.validations, target) for arm, one in learners.items()}, target


def summary(rows: Sequence[dict[str, Any]], times: float) -> dict[str, Any]:
    """Return the ratio of today's seconds to the recipe's, with a 95 % interval over seeds and a verdict.

    Ratios are averaged as logarithms. If the recipe never reached the error for a seed, there are no numbers,
    and the verdict is open.
    """
    import numpy as np

    from memmlp.tables.statistics import seed_effects, verdict

    ratios = [row["today"]["seconds"] / row["recipe"]["seconds"] if row["recipe"] else np.nan for row in rows]
    mean, low, high, p = (float(part[0]) for part in seed_effects(np.log([ratios]) - np.log(times))[:4])
    values = {"ratio": times * np.exp(mean), "low": times * np.exp(low), "high": times * np.exp(high), "p": p}
    numbers = {name: float(value) if np.isfinite(value) else None for name, value in values.items()}
    never = [row["seed"] for row in rows if not row["recipe"]]
    return {**numbers, "verdict": str(verdict(p, np.nan, mean, 1.0)), "times": times, "never": never}


def write(
    file: Path,
    subject: dict[str, Any],
    made_by: dict[str, Any],
    rows: dict[int, dict[str, Any]],
    times: float,
) -> None:
    """Write the measurements, with their unit, what made all of them (`maker`) and the summary so far."""
    from memmlp.common.files import write_json

    every = list(rows.values())
    about = {"subject": subject, "made_by": made_by, "unit": f"seconds {of_processor(made_by['threads'])}"}
    write_json(file, {**about, "seeds": every, "summary": summary(every, times)})


def seed_line(row: dict[str, Any], error: str) -> str:
    """Return the line for a seed."""
    parts = [f"seed {row['seed']}: {error} {row['target']:.3f} {UNITS[error]}"]
    for arm in ARMS:
        mark = row[arm]
        parts.append(f"{arm} {mark['steps']} steps, {mark['seconds']:.1f} s" if mark else f"{arm} never")
    return "; ".join(parts)


def conclusion(found: dict[str, Any], threads: int) -> str:
    """Return the last line: ratio, whose time it is of, interval, verdict."""
    claim = f"at least {found['times']:g} times: {found['verdict']}"
    if found["never"]:
        return f"the recipe never had the error with seed {', '.join(map(str, found['never']))}; {claim}"
    several = found["low"] is not None
    mine = f"in seconds {of_processor(threads)}"
    interval = f"{found['low']:.2f} to {found['high']:.2f}" if several else "none, of one seed"
    return f"{found['ratio']:.2f} times sooner {mine} (95 % interval over seeds: {interval}); {claim}"


def show_breakdown(arm: str, words: Sequence[str], steps: int) -> None:
    """Print how long a step takes, and each of its parts."""
    import torch

    from memmlp.training.step_profile import PHASES, step_phases

    experiment = compose_experiment((*words, f"optim.steps={WARM_UP + 2 * steps}"))
    one = learner(experiment, experiment.motion.prepare())
    one.take(WARM_UP)
    before = one.seconds
    one.take(steps)
    alone = 1000 * (one.seconds - before) / steps
    parts = step_phases(one.take, steps)
    whole = sum(parts.values())
    mine = of_processor(torch.get_num_threads())
    click.echo(f"{arm}: a step takes {alone:.1f} ms {mine}; with the profiler {whole:.1f} ms pass,")
    click.echo(f"  {whole / parts[PHASES[0]]:.2f} times its matrix products:")
    for name, value in parts.items():
        click.echo(f"  {name:<16}{value:8.2f} ms  {100 * value / whole:5.1f} %")
