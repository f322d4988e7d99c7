"""`memmlp bench train`: how soon a changed recipe of training reaches the final error of the current one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from memmlp.cli.options import Finite, config_dir_option, plugins_option

if TYPE_CHECKING:
    from memmlp.training.experiment import Experiment

ERRORS = ("MPJRE", "MPJPE", "MPJVE", "Jitter")
BASE = ("profile=small", "device=cpu", "loggers=none")


@click.command("train")
@click.option("--recipe", required=True, help="Overrides of the changed recipe, separated by spaces.")
@click.option("--seeds", default=5, show_default=True, type=click.IntRange(1), help="How many seeds, from 0.")
@click.option(
    "--error", default="MPJPE", show_default=True, type=click.Choice(ERRORS), help="Which error counts."
)
@click.option(
    "--every", default=50, show_default=True, type=click.IntRange(1), help="Steps between validations."
)
@click.option(
    "--times",
    default=1.0,
    show_default=True,
    type=Finite(min=0, min_open=True),
    help="The claim to judge: how many times sooner.",
)
@click.option(
    "--json",
    "file",
    type=click.Path(path_type=Path),
    help="JSON file, written after each seed; seeds that it already has are not measured again.",
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
    overrides: tuple[str, ...],
) -> None:
    """Time a recipe of training beside the current one.

    The current recipe is `memmlp train` with OVERRIDES (by default profile=small); the changed one adds the
    overrides of --recipe. For each seed both are trained on the CPU, in turn, piece by piece. The command
    prints when each first had the validation error (stream mode) with which the current one ends: in steps
    and in processor seconds (summed over threads), without validations. It ends with the ratio of the
    seconds and its interval over seeds.
    """
    import shlex

    from memmlp.common.errors import InputError
    from memmlp.common.files import read_json, write_json

    changes = tuple(shlex.split(recipe))
    if any(word.lstrip("+").startswith("threads=") for word in changes):
        raise InputError("--recipe threads: set threads among OVERRIDES, which both recipes share")
    subject = {"overrides": list(overrides), "recipe": list(changes), "error": error, "every": every}
    rows: dict[int, dict[str, Any]] = {}
    if file and not file.absolute().parent.is_dir():
        raise InputError(f"--json {file}: there is no folder {file.parent}")
    if file and file.exists():
        content = read_json(file)
        if content.get("subject") != subject:
            raise InputError(
                f"--json {file}: is of another comparison; expected a new file or the same options"
            )
        rows = {row["seed"]: row for row in content["seeds"]}
    for seed in range(seeds):
        both = {
            name: compose_experiment((*BASE, *overrides, *words, f"seed={seed}"))
            for name, words in (("current", ()), ("recipe", changes))
        }
        rows[seed] = measure_seed(both, seed, error, every, rows.get(seed))
        click.echo(describe_seed(rows[seed], error))
        if file:
            found = list(rows.values())
            write_json(file, {"subject": subject, "seeds": found, "summary": summarize(found, times)})
    click.echo(conclude(summarize([rows[seed] for seed in range(seeds)], times)))


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
        raise InputError(f"device={experiment.device}: must be cpu, because processor time is measured")
    if not isinstance(experiment.training, NetworkTraining):
        raise InputError("refiner: must be null; bench train times a network's training")
    if threads := experiment.config["threads"]:
        torch.set_num_threads(threads)
    return experiment


def measure_seed(
    experiments: dict[str, Experiment], seed: int, error: str, every: int, known: dict[str, Any] | None
) -> dict[str, Any]:
    """Return the row of a seed: the error, when each recipe reached it, and the ids of both runs.

    Args:
        experiments: the experiments of both recipes, "current" and "recipe".
        seed: their seed.
        error: the error's name.
        every: steps between validations, after which the other training has its turn.
        known: the row that exists already.

    Raises:
        InputError: if the recipes differ in something that is not timed, or the known row belongs to other
            runs.
    """
    import math
    from collections import deque

    from memmlp.common.errors import InputError
    from memmlp.common.progress import progress_bar
    from memmlp.training.run_stages import make_prerequisites
    from memmlp.training.time_to_error import Learner, find_first, train_in_turn
    from memmlp.training.train_network import NetworkTraining

    data = {name: experiment.motion.prepare() for name, experiment in experiments.items()}
    runs = {name: experiment.identity(data[name].digest) for name, experiment in experiments.items()}
    ids = {name: run.id for name, run in runs.items()}
    if known is not None:
        if known["runs"] != ids:
            raise InputError(
                f"--json: seed {seed} has other configs, component versions or data; use a new file"
            )
        return known
    if len({(run.data, run.prerequisite.id if run.prerequisite else None) for run in runs.values()}) > 1:
        raise InputError("--recipe: must not change the data or the VQ-VAE, which are not timed")
    learners = {}
    for name, experiment in experiments.items():
        training = experiment.training
        assert isinstance(training, NetworkTraining)
        training.optim.check_installed()
        above = make_prerequisites(experiment, data[name])
        weights = above.weights() if above else None
        task = training.task(experiment.architecture, data[name], weights, experiment.device)
        learners[name] = Learner(task, training.optim, training.seed, f"rotation {error}")
    pieces = sum(math.ceil(one.optim.steps / every) for one in learners.values())
    turns = train_in_turn(
        [learners["recipe"], learners["current"]], every
    )  # the current one has no cold start
    deque(progress_bar(turns, f"seed {seed}", pieces), maxlen=0)
    target = learners["current"].validations[-1].error
    reached = {name: find_first(one.validations, target) for name, one in learners.items()}
    marks = {name: one._asdict() if one else None for name, one in reached.items()}
    return {"seed": seed, "runs": ids, "target": target, **marks}


def summarize(rows: Sequence[dict[str, Any]], times: float) -> dict[str, Any]:
    """Return the ratio of the current seconds to the recipe's, with a 95 % interval over seeds and a verdict.

    Ratios are averaged as logarithms. If the recipe never reached the error for a seed, there are no numbers,
    and the verdict is inconclusive.
    """
    import numpy as np

    from memmlp.report.tables.statistics import seed_effects, verdict

    ratios = [
        row["current"]["seconds"] / row["recipe"]["seconds"] if row["recipe"] else np.nan for row in rows
    ]
    mean, low, high, p = (float(part[0]) for part in seed_effects(np.log([ratios]) - np.log(times))[:4])
    values = {"ratio": times * np.exp(mean), "low": times * np.exp(low), "high": times * np.exp(high), "p": p}
    numbers = {name: float(value) if np.isfinite(value) else None for name, value in values.items()}
    never = [row["seed"] for row in rows if not row["recipe"]]
    return {**numbers, "verdict": str(verdict(p, np.nan, mean, 1.0)), "times": times, "never": never}


def describe_seed(row: dict[str, Any], error: str) -> str:
    """Return the line for a seed."""
    from memmlp.evaluation.metric_facts import UNITS

    parts = [f"seed {row['seed']}: {error} {row['target']:.3f} {UNITS[error]}"]
    for name in ("current", "recipe"):
        mark = row[name]
        parts.append(f"{name} {mark['steps']} steps, {mark['seconds']:.1f} s" if mark else f"{name} never")
    return "; ".join(parts)


def conclude(found: dict[str, Any]) -> str:
    """Return the last line: ratio, interval, verdict."""
    claim = f"at least {found['times']:g} times: {found['verdict']}"
    if found["never"]:
        return f"the recipe never reached the error with seed {', '.join(map(str, found['never']))}; {claim}"
    interval = "none from one seed" if found["low"] is None else f"{found['low']:.2f} to {found['high']:.2f}"
    return f"{found['ratio']:.2f} times sooner in processor seconds (95 % interval: {interval}); {claim}"
