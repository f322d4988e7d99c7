"""Time a step of each network in ONNX Runtime: the bare network, the deployed step and the end-to-end pose.

Run `python benchmarks/latency.py --rounds 9 --json FILE`; docs/results/latency.md has the output.
"""

import tempfile
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import click
import numpy as np
import torch
from rich.table import Table

from memmlp.cli.options import PATH, config_dir_option, plugins_option
from memmlp.common.errors import InputError
from memmlp.common.files import write_json
from memmlp.common.processes import CoreUsageTimer
from memmlp.common.progress import progress_bar
from memmlp.common.text_formats import make_console
from memmlp.config.build import build_untrained
from memmlp.deploy.export import export
from memmlp.deploy.latency import strip_conversions
from memmlp.deploy.lower_precision import write_lower_precision
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.live.pose_latency import time_poses
from memmlp.live.stream import Stream
from memmlp.motion.body import FRAME_DIM
from memmlp.networks.streaming import has_streaming_graph, make_streaming_graph
from memmlp.runs.environment import describe_environment

CACHE_BYTES = 2**28  # more than a processor's caches
SETTLING = 3  # number of untimed steps at the start of each round
Key = TypeVar("Key", bound=Hashable)
BASE = "avatar_poser"
"""The reference network of all ratios, with its default size."""
DEFAULT_MODELS = (
    f"{BASE},agrol_mlp,agrol_mlp@41,agrol_diffusion,mem_mlp,mem_mlp@60,ego_poser,hmd_poser,vae_hmd,rpm,"
    "manikin_s,recurrent_poser"
)
LOWER_PRECISIONS = ("fp16", "int8")
DEPLOYED = ("naive", "streaming", *LOWER_PRECISIONS)
GRAPHS = ("network", *DEPLOYED)


class RoundTimes(NamedTuple):
    """Step times of one file, measured in rounds with other files.

    Attributes:
        seconds: the time of each step (rounds, steps), in seconds.
        core_fractions: the fraction of each round (rounds,) in which the thread ran on a core.
    """

    seconds: np.ndarray
    core_fractions: np.ndarray


def time_steps_in_rounds(
    paths: Mapping[Key, Path], rounds: int, steps: int, cold: bool = False
) -> dict[Key, RoundTimes]:
    """Time the steps of exported files on one thread. Each round times all files.

    The first steps of a file in each round only fill the caches, and are not counted. With `cold`, the caches
    are filled with other data before each step.
    """
    other = np.zeros(CACHE_BYTES, np.uint8)
    streams = {key: OnnxStream(path) for key, path in paths.items()}
    random = np.random.default_rng(0)
    given = {
        key: [np.asarray(random.normal(size=array.shape), np.float32) for array in stream.inputs.values()]
        for key, stream in streams.items()
    }

    def time_round(key: Key) -> np.ndarray:
        seconds = np.zeros(SETTLING + steps)
        for step in range(len(seconds)):
            if cold:
                np.add(other, 1, out=other)
            start = time.perf_counter()
            streams[key].step(*given[key])
            seconds[step] = time.perf_counter() - start
        return seconds[SETTLING:]

    return time_in_rounds(paths, rounds, time_round)


def time_in_rounds(
    keys: Iterable[Key], rounds: int, time_round: Callable[[Key], np.ndarray]
) -> dict[Key, RoundTimes]:
    """Time all files in each round. The order of the files is reversed after each round.

    Args:
        keys: the keys of the files.
        rounds: number of rounds.
        time_round: times the steps of one file in one round, and returns the seconds (steps,).
    """
    order = list(keys)
    seconds: dict[Key, list[np.ndarray]] = {key: [] for key in order}
    shares: dict[Key, list[float]] = {key: [] for key in order}
    for _ in range(rounds):
        for key in order:
            clock = CoreUsageTimer()
            seconds[key].append(time_round(key))
            shares[key].append(clock.fraction)
        order.reverse()
    return {key: RoundTimes(np.array(seconds[key]), np.array(shares[key])) for key in seconds}


def time_poses_in_rounds(paths: Mapping[Key, Path], rounds: int, steps: int) -> dict[Key, RoundTimes]:
    """Time end-to-end poses of exported networks on one thread. Each round times all files, without its first
    poses."""
    streams = {key: Stream(path) for key, path in paths.items()}
    return time_in_rounds(paths, rounds, lambda key: time_poses(streams[key], SETTLING + steps)[SETTLING:])


@click.command(context_settings={"show_default": True})
@click.option("--rounds", default=5, type=click.IntRange(5), help="Number of timed rounds.")
@click.option("--steps", default=20, type=click.IntRange(2), help="Number of steps per round.")
@click.option(
    "--models",
    default=DEFAULT_MODELS,
    help="Options of `model`, separated by commas. NAME@FRAMES sets model.frames, NAME+KEY=VALUE any key.",
)
@click.option(
    "--cold",
    is_flag=True,
    help="Fill the processor's caches with other data before each step, and do not time poses.",
)
@click.option("--json", "file", type=PATH, help="JSON file to write the rows into.")
@click.argument("overrides", nargs=-1)
@config_dir_option
@plugins_option
def latency(
    rounds: int, steps: int, models: str, cold: bool, file: Path | None, overrides: tuple[str, ...]
) -> None:
    """Time a step of each network.

    All networks run in ONNX Runtime, in turn, in one process with one thread. The command times three things:
    the bare network; the deployed step, which adds conversions and forward kinematics; and the end-to-end
    pose, from tracker poses to joints. Streaming graphs are timed for networks that have one.

    OVERRIDES are those of `memmlp train`; the default is profile=paper. Weights are random, which does not
    affect the times. Ratios compare the medians of each round: steps with AvatarPoser's bare network, and
    poses with AvatarPoser's pose.
    """
    chosen = [name.strip() for name in models.split(",")]
    if BASE not in chosen:
        raise InputError(f"--models {models}: must include {BASE}, the reference of the ratios")
    if named := [word for word in overrides if word.lstrip("+").startswith(("model=", "model.frames="))]:
        raise InputError(f"{named[0]}: set networks and their windows with --models")
    if file and not file.absolute().parent.is_dir():
        raise InputError(f"--json {file}: there is no folder {file.parent}")
    with tempfile.TemporaryDirectory() as folder:
        rows = time_all(dict(export_all(chosen, overrides, Path(folder))), rounds, steps, cold)
    show(rows, rounds)
    if file:
        how = {"overrides": list(overrides), "rounds": rounds, "steps": steps, "cold": cold, "threads": 1}
        write_json(file, {**how, "made_by": describe_environment(), "rows": rows})


def export_all(
    models: list[str], overrides: tuple[str, ...], folder: Path
) -> Iterator[tuple[tuple[str, str], Path]]:
    """Export each model's graphs, with a progress bar, and yield pairs of (model, graph) and file."""
    clips = [0.1 * torch.randn(60, FRAME_DIM, generator=torch.Generator().manual_seed(0))]
    for name in progress_bar(models, "exporting"):
        named, *own = name.split("+")
        option, _, frames = named.partition("@")
        size = (f"model.frames={frames}",) if frames else ()
        model = build_untrained(("profile=paper", *overrides, f"model={option}", *size, *own))
        files = {graph: folder / f"{name}.{graph}.onnx" for graph in GRAPHS}
        export(strip_conversions(model), files["network"], "random")
        export(model, files["naive"], "random")
        if has_streaming_graph(model):
            stream = make_streaming_graph(model)
            export(stream, files["streaming"], "random")
            for precision in LOWER_PRECISIONS:
                write_lower_precision(precision, files["streaming"], files[precision], stream, clips)
        yield from (((name, graph), path) for graph, path in files.items() if path.exists())


def time_all(paths: dict[tuple[str, str], Path], rounds: int, steps: int, cold: bool) -> list[dict[str, Any]]:
    """Time the steps of all files in turn, then the end-to-end poses of deployed files; see `summarize`. With
    `cold`, only the steps are timed, each with its weights out of the caches."""
    times = time_steps_in_rounds(paths, rounds, steps, cold)
    deployed = {key: path for key, path in paths.items() if key[1] in DEPLOYED and not cold}
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
    print(f"milliseconds on one thread; each of {rounds} rounds times all networks")
    print("x: the time divided by AvatarPoser's time, for the network or for the whole pose")
    print("core: minimum % of a round in which the thread had a core; below 90, the times are unreliable")
    table = Table(box=None, pad_edge=False)
    table.add_column("network", overflow="fold", min_width=16)
    table.add_column("graph", no_wrap=True)
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


if __name__ == "__main__":
    latency()
