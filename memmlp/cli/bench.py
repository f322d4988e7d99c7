"""`memmlp bench`: time network steps, poses and training steps on this machine."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from memmlp.cli.options import PATH, config_dir_option, plugins_option

if TYPE_CHECKING:
    from memmlp.deploy.latency import RoundTimes
    from memmlp.training.step_cost import StepCost

BASE = "avatar_poser"
"""The reference network of all ratios, with its default size."""
DEFAULT_MODELS = (
    f"{BASE},agrol_mlp,agrol_mlp@41,agrol_diffusion,mem_mlp,mem_mlp@60,ego_poser,hmd_poser,vae_hmd,rpm,"
    "manikin_s,recurrent_poser"
)
LOWER_PRECISIONS = ("fp16", "int8")
DEPLOYED = ("naive", "streaming", *LOWER_PRECISIONS)
GRAPHS = ("network", *DEPLOYED)


@click.group("bench")
def bench() -> None:
    """Measure speed on this machine."""


@bench.command("latency")
@click.option("--rounds", default=5, type=click.IntRange(5), help="Number of timed rounds.")
@click.option("--steps", default=20, type=click.IntRange(2), help="Number of steps per round.")
@click.option(
    "--models",
    default=DEFAULT_MODELS,
    help="Options of `model` to time, separated by commas; NAME@FRAMES sets model.frames.",
)
@click.option("--json", "file", type=PATH, help="JSON file to write the rows into.")
@click.argument("overrides", nargs=-1)
@config_dir_option
@plugins_option
def latency(rounds: int, steps: int, models: str, file: Path | None, overrides: tuple[str, ...]) -> None:
    """Time a step of each network.

    All networks run in ONNX Runtime, in turn, in one process with one thread. The command times three things:
    the bare network; the deployed step, which adds conversions and forward kinematics; and the end-to-end
    pose, from tracker poses to joints. Streaming graphs are timed for networks that have one.

    OVERRIDES are those of `memmlp train`; the default is profile=paper. Weights are random, which does not
    affect the times. Ratios compare the medians of each round: steps with AvatarPoser's bare network, and
    poses with AvatarPoser's pose.
    """
    from memmlp.common.errors import InputError

    chosen = [name.strip() for name in models.split(",")]
    if BASE not in chosen:
        raise InputError(f"--models {models}: must include {BASE}, the reference of the ratios")
    if named := [word for word in overrides if word.lstrip("+").startswith(("model=", "model.frames="))]:
        raise InputError(f"{named[0]}: set networks and their windows with --models")
    if file and not file.absolute().parent.is_dir():
        raise InputError(f"--json {file}: there is no folder {file.parent}")
    with tempfile.TemporaryDirectory() as folder:
        rows = time_all(dict(export_all(chosen, overrides, Path(folder))), rounds, steps)
    show(rows, rounds)
    if file:
        from memmlp.common.files import write_json
        from memmlp.runs.environment import describe_environment

        how = {"overrides": list(overrides), "rounds": rounds, "steps": steps, "threads": 1}
        write_json(file, {**how, "made_by": describe_environment(), "rows": rows})


def export_all(
    models: list[str], overrides: tuple[str, ...], folder: Path
) -> Iterator[tuple[tuple[str, str], Path]]:
    """Export each model's graphs, with a progress bar, and yield pairs of (model, graph) and file."""
    import torch

    from memmlp.common.progress import progress_bar
    from memmlp.config.build import build_untrained
    from memmlp.deploy.export import export
    from memmlp.deploy.latency import strip_conversions
    from memmlp.deploy.lower_precision import write_lower_precision
    from memmlp.motion.body import FRAME_DIM
    from memmlp.networks.streaming import has_streaming_graph, make_streaming_graph

    clips = [0.1 * torch.randn(60, FRAME_DIM, generator=torch.Generator().manual_seed(0))]
    for name in progress_bar(models, "exporting"):
        option, _, frames = name.partition("@")
        size = (f"model.frames={frames}",) if frames else ()
        model = build_untrained(("profile=paper", *overrides, f"model={option}", *size))
        files = {graph: folder / f"{name}.{graph}.onnx" for graph in GRAPHS}
        export(strip_conversions(model), files["network"], "random")
        export(model, files["naive"], "random")
        if has_streaming_graph(model):
            stream = make_streaming_graph(model)
            export(stream, files["streaming"], "random")
            for precision in LOWER_PRECISIONS:
                write_lower_precision(precision, files["streaming"], files[precision], stream, clips)
        yield from (((name, graph), path) for graph, path in files.items() if path.exists())


def time_all(paths: dict[tuple[str, str], Path], rounds: int, steps: int) -> list[dict[str, Any]]:
    """Time the steps of all files in turn, then the end-to-end poses of deployed files; see `summarize`."""
    from memmlp.deploy.latency import time_steps_in_rounds
    from memmlp.live.pose_latency import time_poses_in_rounds

    times = time_steps_in_rounds(paths, rounds, steps)
    deployed = {key: path for key, path in paths.items() if key[1] in DEPLOYED}
    poses = time_poses_in_rounds(deployed, rounds, steps)
    return [
        {"model": key[0], "variant": key[1]}
        | summarize("", times[key], times[BASE, "network"])
        | (summarize("pose_", poses[key], poses[BASE, "naive"]) if key in poses else {})
        for key in paths
    ]


def summarize(prefix: str, times: RoundTimes, base: RoundTimes) -> dict[str, float]:
    """Summarize a file's times, under keys with this prefix: median and 95th percentile in milliseconds; the
    ratio of its median to the reference file's: median, minimum and maximum over the rounds; and the minimum,
    over the rounds, of the fraction of time in which the thread had a core."""
    import numpy as np

    ratios = np.median(times.seconds, 1) / np.median(base.seconds, 1)
    return {
        f"{prefix}median_ms": 1000 * float(np.median(times.seconds)),
        f"{prefix}p95_ms": 1000 * float(np.percentile(times.seconds, 95)),
        f"{prefix}ratio_to_avatar_poser": float(np.median(ratios)),
        f"{prefix}ratio_least": float(ratios.min()),
        f"{prefix}ratio_most": float(ratios.max()),
        f"{prefix}core_share": float(times.core_fractions.min()),
    }


def show(rows: list[dict[str, Any]], rounds: int) -> None:
    """Print the rows as a table with one line per row, 80 characters wide."""
    from rich.table import Table

    from memmlp.common.text_formats import make_console

    print(f"milliseconds on one thread; each of {rounds} rounds times all networks")
    print("x: the time divided by AvatarPoser's time, for the network or for the whole pose")
    print("core: minimum % of a round in which the thread had a core; below 90, the times are unreliable")
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
            *(shorten_number(row[key]) for key in ("median_ms", "p95_ms", "ratio_to_avatar_poser")),
            f"{shorten_number(row['ratio_least'])}-{shorten_number(row['ratio_most'])}",
            *("" if value is None else shorten_number(value) for value in pose),
            f"{100 * core:.0f}",
        )
    make_console().print(table)


def shorten_number(number: float) -> str:
    """Return a number in at most four characters, so that a row fits a line of 80."""
    return f"{number:.2f}" if number < 10 else f"{number:.1f}" if number < 100 else f"{number:.0f}"


@bench.command("train")
@click.option("--rounds", default=5, type=click.IntRange(1), help="Number of timed rounds.")
@click.option("--steps", default=10, type=click.IntRange(1), help="Number of steps per round.")
@click.option("--profile", "kernels", is_flag=True, help="Also print the slowest functions of torch.")
@click.argument("overrides", nargs=-1)
@config_dir_option
@plugins_option
def train(rounds: int, steps: int, kernels: bool, overrides: tuple[str, ...]) -> None:
    """Time a training step, and its matrix products alone.

    OVERRIDES are those of `memmlp train`. The step runs on one thread of the CPU; times are processor times.
    Each round times some steps, then the same matrix products by themselves. A VQ-VAE has random weights,
    which does not affect the times; other prerequisite runs are trained if they are missing.
    """
    import numpy as np

    cost = measure_training_step(overrides, rounds, steps, kernels)
    step, products, ratio = map(np.median, (cost.step_ms, cost.product_ms, cost.ratios))
    print(f"milliseconds on one thread, median of {rounds} rounds of {steps} steps")
    print(f"{step:8.2f} training step")
    print(f"{products:8.2f} its matrix products alone, {cost.flops / 1e9:.3g} GFLOP")
    print(f"{ratio:8.2f} times the products, from {cost.ratios.min():.2f} to {cost.ratios.max():.2f}")
    for name, milliseconds, calls in cost.kernels[:20]:
        print(f"{milliseconds:8.2f} {name}, {calls:g} calls")


def measure_training_step(
    overrides: tuple[str, ...], rounds: int, steps: int, with_kernels: bool
) -> StepCost:
    """Measure the training step that overrides configure; see `measure_step_cost`."""
    import torch

    from memmlp.common.errors import InputError
    from memmlp.config.build import build_experiment
    from memmlp.config.compose import compose_config
    from memmlp.networks import checkpoint
    from memmlp.training.run_stages import make_prerequisites
    from memmlp.training.step_cost import measure_step_cost
    from memmlp.training.train_network import NetworkTraining

    experiment = build_experiment(compose_config(overrides))
    training, architecture = experiment.training, experiment.architecture
    if experiment.device.type != "cpu":
        raise InputError(f"device={experiment.config['device']}: must be cpu, whose time is measured")
    if not isinstance(training, NetworkTraining):
        raise InputError("refiner: must be null, since the steps of a network's training are timed")
    training.optim.check_installed()
    data = experiment.motion.prepare()
    with tempfile.TemporaryDirectory() as folder:
        weights = None
        if architecture.uses_codes:
            torch.manual_seed(0)
            weights = Path(folder) / "vqvae.safetensors"
            codes = checkpoint.collect_module_tensors("model", architecture.vqvae())
            checkpoint.write(weights, codes, {})
        elif run := make_prerequisites(experiment, data):
            weights = run.weights()
        task = training.make_task(architecture, data, weights, experiment.device)
    return measure_step_cost(task, training.optim, rounds, steps, with_kernels)
