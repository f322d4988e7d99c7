"""`memmlp bench`: the time of networks' steps and poses, and of other training settings, on this machine."""

from __future__ import annotations

import math
import shlex
import tempfile
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from memmlp.cli.options import Finite, config_dir_option, plugins_option

if TYPE_CHECKING:
    from memmlp.deploy.latency import InTurn
    from memmlp.training.run_stages import Experiment

BASE = "avatar_poser"
"""The network whose times are the unit of all ratios, in the size of its option."""
DEFAULT_MODELS = (
    f"{BASE},agrol_mlp,agrol_mlp@41,agrol_diffusion,mem_mlp,mem_mlp@60,ego_poser,hmd_poser,vae_hmd,rpm,"
    "manikin_s,recurrent_poser"
)
LOWER = ("fp16", "int8", "int8_blocks")
DEPLOYED = ("naive", "streaming", *LOWER)
GRAPHS = ("network", *DEPLOYED)


ERROR = "MPJPE"
TRAINED = ("profile=small", "device=cpu", "loggers=none")


@click.group("bench")
def bench() -> None:
    """Measure speed on this machine: rates, and ratios within one process."""


def check_json(file: Path | None) -> None:
    """Raise InputError for a file in a folder that does not exist."""
    from memmlp.common.errors import InputError

    if file and not file.absolute().parent.is_dir():
        raise InputError(f"--json {file}: there is no folder {file.parent}")


@bench.command("latency")
@click.option("--rounds", default=5, show_default=True, type=click.IntRange(5), help="Timed rounds.")
@click.option("--steps", default=20, show_default=True, type=click.IntRange(2), help="Steps in a round.")
@click.option(
    "--models",
    default=DEFAULT_MODELS,
    show_default=True,
    help="Options of `model` to time, separated by commas; NAME@FRAMES sets model.frames.",
)
@click.option("--json", "file", type=click.Path(path_type=Path), help="JSON file to write the rows into.")
@click.argument("overrides", nargs=-1)
@config_dir_option
@plugins_option
def latency(rounds: int, steps: int, models: str, file: Path | None, overrides: tuple[str, ...]) -> None:
    """Time a step of every network.

    All run in ONNX Runtime, in turn in one process, on one thread: the network alone, from features to its
    own outputs; the deployed steps, which include conversions and forward kinematics; and a whole pose, from
    a sample of the trackers to the joints. OVERRIDES are those of `memmlp train`; the default is
    profile=paper. Weights are random, which does not matter for the time. Ratios are of each round's medians:
    a step's to AvatarPoser's network alone, a pose's to AvatarPoser's pose. The streaming graph is timed
    where the network has one.
    """
    from memmlp.common.errors import InputError

    chosen = [name.strip() for name in models.split(",")]
    if BASE not in chosen:
        raise InputError(f"--models {models}: must include {BASE}, for the comparison")
    if named := [word for word in overrides if word.lstrip("+").startswith(("model=", "model.frames="))]:
        raise InputError(f"{named[0]}: set networks and their windows with --models")
    check_json(file)
    with tempfile.TemporaryDirectory() as folder:
        rows = time_all(dict(export_all(chosen, overrides, Path(folder))), rounds, steps)
    show(rows, rounds)
    if file:
        from memmlp.common.files import write_json
        from memmlp.runs.environment import environment

        how = {"overrides": list(overrides), "rounds": rounds, "steps": steps, "threads": 1}
        write_json(file, {**how, "made_by": environment(), "rows": rows})


def export_all(
    models: list[str], overrides: tuple[str, ...], folder: Path
) -> Iterator[tuple[tuple[str, str], Path]]:
    """Export each model's graphs, with a progress bar, and yield (model, graph) with the file."""
    import torch

    from memmlp.common.progress import progress_bar
    from memmlp.config.build import untrained
    from memmlp.deploy.export import export
    from memmlp.deploy.latency import strip_conversions
    from memmlp.deploy.lower_precision import lower
    from memmlp.motion.body import FRAME_DIM
    from memmlp.networks.streaming import has_stream, streaming

    clips = [0.1 * torch.randn(60, FRAME_DIM, generator=torch.Generator().manual_seed(0))]
    for name in progress_bar(models, "exporting"):
        option, _, frames = name.partition("@")
        size = (f"model.frames={frames}",) if frames else ()
        model = untrained(("profile=paper", *overrides, f"model={option}", *size))
        files = {graph: folder / f"{name}.{graph}.onnx" for graph in GRAPHS}
        export(strip_conversions(model), files["network"], "random")
        export(model, files["naive"], "random")
        if has_stream(model):
            stream = streaming(model)
            export(stream, files["streaming"], "random")
            for precision in LOWER:
                lower(precision, files["streaming"], files[precision], stream, clips)
        yield from (((name, graph), path) for graph, path in files.items() if path.exists())


def time_all(paths: dict[tuple[str, str], Path], rounds: int, steps: int) -> list[dict[str, Any]]:
    """Time all files in turn: their steps, then the whole poses of the deployed ones; see `summarize`."""
    from memmlp.deploy.latency import time_in_turn
    from memmlp.live.pose_latency import time_poses_in_turn

    times = time_in_turn(paths, rounds, steps)
    deployed = {key: path for key, path in paths.items() if key[1] in DEPLOYED}
    poses = time_poses_in_turn(deployed, rounds, steps)
    return [
        {"model": key[0], "variant": key[1]}
        | summarize("", times[key], times[BASE, "network"])
        | (summarize("pose_", poses[key], poses[BASE, "naive"]) if key in poses else {})
        for key in paths
    ]


def summarize(prefix: str, times: InTurn, base: InTurn) -> dict[str, float]:
    """Summarize a file's times.

    Args:
        prefix: the beginning of the keys.
        times: its times.
        base: the times of the file with which it is compared.

    Returns:
        Median and 95th percentile in milliseconds; the median, minimum and maximum, over the rounds, of the
        ratio of both medians; and the least share of a round in which the thread had a core.
    """
    import numpy as np

    ratios = np.median(times.seconds, 1) / np.median(base.seconds, 1)
    return {
        f"{prefix}median_ms": 1000 * float(np.median(times.seconds)),
        f"{prefix}p95_ms": 1000 * float(np.percentile(times.seconds, 95)),
        f"{prefix}ratio_to_avatar_poser": float(np.median(ratios)),
        f"{prefix}ratio_least": float(ratios.min()),
        f"{prefix}ratio_most": float(ratios.max()),
        f"{prefix}core_share": float(times.core_shares.min()),
    }


def show(rows: list[dict[str, Any]], rounds: int) -> None:
    """Print the rows as a table of 80 columns, one line each."""
    from rich.console import Console
    from rich.table import Table

    print(f"milliseconds on one thread, {rounds} rounds in turn; x: ratio to AvatarPoser's network or pose")
    print("core: the least % of a round in which the thread had a core; below 90, other work is in the times")
    table = Table(box=None, pad_edge=False)
    for name in ("network", "graph"):
        table.add_column(name, no_wrap=True)
    for name in ("step", "p95", "x", "rounds", "pose", "x", "core"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        pose = [row.get("pose_median_ms"), row.get("pose_ratio_to_avatar_poser")]
        core = min(row["core_share"], row.get("pose_core_share", 1.0))
        table.add_row(
            row["model"],
            row["variant"],
            *(shorten(row[key]) for key in ("median_ms", "p95_ms", "ratio_to_avatar_poser")),
            f"{shorten(row['ratio_least'])}-{shorten(row['ratio_most'])}",
            *("" if value is None else shorten(value) for value in pose),
            f"{100 * core:.0f}",
        )
    Console().print(table)


def shorten(number: float) -> str:
    """Return a number in at most four characters, so that a row fits a line of 80."""
    return f"{number:.2f}" if number < 10 else f"{number:.1f}" if number < 100 else f"{number:.0f}"


@bench.command("train")
@click.option("--recipe", required=True, help="Overrides of the changed recipe, separated by spaces.")
@click.option("--seeds", default=5, show_default=True, type=click.IntRange(1), help="How many seeds, from 0.")
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
    help="JSON file to write after each seed.",
)
@click.argument("overrides", nargs=-1)
@config_dir_option
@plugins_option
def train(
    recipe: str, seeds: int, every: int, times: float, file: Path | None, overrides: tuple[str, ...]
) -> None:
    """Time a recipe of training beside the current one.

    The current recipe is `memmlp train` with OVERRIDES (by default profile=small); the changed one adds the
    overrides of --recipe. For each seed both are trained on the CPU, in turn, piece by piece. The command
    prints when each first had the validation MPJPE (stream mode) with which the current one ends: in steps
    and in processor seconds (summed over threads), without validations. It ends with the ratio of the
    seconds and its interval over seeds.
    """
    from memmlp.common.errors import InputError
    from memmlp.common.files import write_json

    changes = tuple(shlex.split(recipe))
    if any(word.lstrip("+").startswith("threads=") for word in changes):
        raise InputError("--recipe threads: set threads among OVERRIDES, which both recipes share")
    check_json(file)
    rows: list[dict[str, Any]] = []
    for seed in range(seeds):
        both = {
            name: compose_experiment((*TRAINED, *overrides, *words, f"seed={seed}"))
            for name, words in (("current", ()), ("recipe", changes))
        }
        rows.append(measure_seed(both, seed, every))
        click.echo(describe_seed(rows[-1]))
        if file:
            subject = {"overrides": list(overrides), "recipe": list(changes), "every": every}
            write_json(file, {"subject": subject, "seeds": rows, "summary": summarize_seeds(rows, times)})
    click.echo(conclude(summarize_seeds(rows, times)))


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


def measure_seed(experiments: dict[str, Experiment], seed: int, every: int) -> dict[str, Any]:
    """Return the row of a seed: the error, when each recipe reached it, and the ids of both runs.

    Args:
        experiments: the experiments of both recipes, "current" and "recipe".
        seed: their seed.
        every: steps between validations, after which the other training has its turn.

    Raises:
        InputError: if the recipes differ in something that is not timed.
    """
    from memmlp.common.errors import InputError
    from memmlp.common.progress import progress_bar
    from memmlp.training.loop import Learner, find_first, train_in_turn
    from memmlp.training.run_stages import make_prerequisites
    from memmlp.training.train_network import NetworkTraining

    data = {name: experiment.motion.prepare() for name, experiment in experiments.items()}
    runs = {name: experiment.identity(data[name].digest) for name, experiment in experiments.items()}
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
        learners[name] = Learner(task, training.optim, training.seed, f"rotation {ERROR}")
    pieces = sum(math.ceil(one.optim.steps / every) for one in learners.values())
    order = [learners["recipe"], learners["current"]]  # the current one has no cold start
    deque(progress_bar(train_in_turn(order, every), f"seed {seed}", pieces), maxlen=0)
    target = learners["current"].validations[-1].error
    reached = {name: find_first(one.validations, target) for name, one in learners.items()}
    marks = {name: one._asdict() if one else None for name, one in reached.items()}
    return {"seed": seed, "runs": {name: run.id for name, run in runs.items()}, "target": target, **marks}


def summarize_seeds(rows: Sequence[dict[str, Any]], times: float) -> dict[str, Any]:
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


def describe_seed(row: dict[str, Any]) -> str:
    """Return the line for a seed."""
    from memmlp.evaluation.metric_facts import UNITS

    parts = [f"seed {row['seed']}: {ERROR} {row['target']:.3f} {UNITS[ERROR]}"]
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
