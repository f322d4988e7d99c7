"""`memmlp bench latency`: each network alone, and its step as trained and as a stream, fp32, fp16, int8."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from memmlp.cli.options import config_dir_option, plugins_option

if TYPE_CHECKING:
    from memmlp.deploy.latency import InTurn

Timed = tuple[str, str]
"""A network in MODELS, and a variant in VARIANTS."""
BASE = ("avatar_poser", "network")
"""The step with which all others are compared: AvatarPoser's network alone, from features to rotations."""
POSE_BASE = ("avatar_poser", "naive")
"""The whole pose with which all others are compared: AvatarPoser's."""
CHECK = ("avatar_poser", "torch")
"""The same layers, written and exported without this project."""

MODELS: dict[str, tuple[str, ...]] = {
    "avatar_poser": ("model=avatar_poser",),
    "agrol_mlp_196": ("model=agrol_mlp", "model.frames=196"),
    "agrol_mlp_41": ("model=agrol_mlp", "model.frames=41"),
    "agrol_diffusion": ("model=agrol_diffusion", "model.sampling_steps=5"),
    "bodiffusion": ("model=bodiffusion",),
    "mem_mlp_41": ("model.frames=41",),
    "mem_mlp_60": ("model.frames=60",),
    "ego_poser": ("model=ego_poser",),
    "hmd_poser": ("model=hmd_poser",),
    "vae_hmd": ("model=vae_hmd",),
    "rpm": ("model=rpm",),
    "manikin_s": ("model=manikin_s",),
    "avatar_jlm": ("model=avatar_jlm",),
    "manikin_l": ("model=manikin_l",),
    "sage": ("model=sage",),
    "recurrent_poser": ("model=recurrent_poser",),
}
SLOW = ("bodiffusion", "avatar_jlm", "manikin_l", "sage")
"""Networks with seconds per step, or gigabytes of files, which are timed only if asked for."""
LOWER = ("fp16", "int8", "int8_blocks")
DEPLOYED = ("naive", "streaming", *LOWER)
VARIANTS = ("network", *DEPLOYED)


@click.command("latency")
@click.option(
    "--rounds",
    default=5,
    show_default=True,
    type=click.IntRange(5),
    help="How many rounds are timed, the networks in turn.",
)
@click.option(
    "--steps",
    default=20,
    show_default=True,
    type=click.IntRange(2),
    help="How many steps of each network a round has.",
)
@click.option(
    "--models",
    default=",".join(name for name in MODELS if name not in SLOW),
    show_default=True,
    help=f"Networks to time, separated by commas; {' and '.join(SLOW)} take minutes, and can be named.",
)
@click.option(
    "--json",
    "file",
    type=click.Path(path_type=Path),
    help="File to write the measured rows into, as JSON, with the overrides and the machine.",
)
@click.option(
    "--breakdown",
    help="Show instead where the time of one network goes: NETWORK:VARIANT, such as mem_mlp_41:int8.",
)
@click.argument("overrides", nargs=-1)
@config_dir_option
@plugins_option
def latency(
    rounds: int, steps: int, models: str, file: Path | None, breakdown: str | None, overrides: tuple[str, ...]
) -> None:
    """Time a step of every network.

    All run in ONNX Runtime, in turn in one process, on one thread: the network alone, from features to its
    own outputs; the steps that are deployed, which convert coordinates and make joints beside; and of these a
    whole pose, from a sample of the trackers to the joints. OVERRIDES are those of `memmlp train`; the
    default is profile=paper. Weights are random: they do not matter for the time. Ratios are of each round's
    medians: a step's to AvatarPoser's network alone, a pose's to AvatarPoser's pose.
    """
    import tempfile

    from memmlp.common.errors import InputError

    chosen = [name.strip() for name in models.split(",")]
    allowed = [f"{name}:{variant}" for name in MODELS for variant in VARIANTS]
    if not set(chosen) <= set(MODELS) or BASE[0] not in chosen:
        raise InputError(
            f"--models {models}: allowed are {', '.join(MODELS)}, with {BASE[0]} for the comparison"
        )
    if breakdown and breakdown not in allowed:
        raise InputError(f"--breakdown {breakdown}: allowed are {', '.join(allowed)}")
    if named := [word for word in overrides if word.lstrip("+").startswith(("model=", "model.frames="))]:
        raise InputError(f"{named[0]}: --models names the networks and their windows; allowed are other keys")
    if file and not file.absolute().parent.is_dir():
        raise InputError(f"--json {file}: there is no folder {file.parent}")
    with tempfile.TemporaryDirectory() as folder:
        paths = dict(export_all(chosen, overrides, Path(folder)))
        rows = timed(paths, rounds, steps)
        show(rows, rounds)
        if warning := busy(rows):
            click.echo(warning, err=True)
        if file:
            from memmlp.common.files import write_json
            from memmlp.runs.environment import environment

            how = {"overrides": list(overrides), "rounds": rounds, "steps": steps, "threads": 1}
            write_json(file, {**how, "made_by": environment(), "rows": rows})
        if breakdown:
            name, variant = breakdown.split(":")
            show_breakdown(paths[name, variant])


def export_all(models: list[str], overrides: tuple[str, ...], folder: Path) -> Iterator[tuple[Timed, Path]]:
    """Export each model in all variants, with a progress bar, and yield (model, variant) with the file."""
    from memmlp.common.progress import progress_bar
    from memmlp.config.build import untrained
    from memmlp.deploy.deployment import lower
    from memmlp.deploy.export import export
    from memmlp.deploy.network_alone import network_alone
    from memmlp.networks.streaming import streaming

    clips = calibration_clips()
    for name in progress_bar(models, "exporting"):
        model = untrained(("profile=paper", *overrides, *MODELS[name]))
        paths = {variant: folder / f"{name}.{variant}.onnx" for variant in VARIANTS}
        stream = streaming(model)
        export(network_alone(model), paths["network"], "random")
        export(model, paths["naive"], "random")
        export(stream, paths["streaming"], "random")
        for precision in LOWER:
            lower(precision, paths["streaming"], paths[precision], stream, clips)
        for variant, path in paths.items():
            yield (name, variant), path
        if name == CHECK[0]:
            yield CHECK, export_independently(overrides, folder / "independent.onnx")


def export_independently(overrides: tuple[str, ...], path: Path) -> Path:
    """Export an AvatarPoser made of torch's own layers, in the config's sizes, and return the file."""
    from memmlp.cli.bench.torch_avatar_poser import TorchAvatarPoser, export_plainly
    from memmlp.config.compose import composed

    sizes = composed(["profile=paper", *overrides, *MODELS[CHECK[0]]]).model
    names = ("frames", "width", "depth", "heads", "feedforward")
    export_plainly(TorchAvatarPoser(**{name: sizes[name] for name in names}), path)
    return path


def calibration_clips() -> list[Any]:
    """Return one short clip (60, 252) of random frames, to calibrate int8."""
    import torch

    from memmlp.motion.body import FRAME_DIM

    return [0.1 * torch.randn(60, FRAME_DIM, generator=torch.Generator().manual_seed(0))]


def timed(paths: dict[Timed, Path], rounds: int, steps: int) -> list[dict[str, Any]]:
    """Time all files in turn: their steps, then the whole poses of those that make any; see `summary`."""
    from memmlp.deploy.latency import time_in_turn
    from memmlp.live.pose_latency import time_poses_in_turn

    whole = time_in_turn(paths, rounds, steps)
    deployed = {key: path for key, path in paths.items() if key[1] in DEPLOYED}
    poses = time_poses_in_turn(deployed, rounds, steps)
    return [
        {"model": key[0], "variant": key[1]}
        | summary("", times, whole[BASE])
        | (summary("pose_", poses[key], poses[POSE_BASE]) if key in poses else {})
        for key, times in whole.items()
    ]


def summary(prefix: str, times: InTurn, base: InTurn) -> dict[str, float]:
    """Summarise a file's times.

    Args:
        prefix: the beginning of the keys.
        times: its times.
        base: the times of the file with which it is compared.

    Returns:
        Median and 95th percentile in milliseconds; the median, minimum and maximum, over the rounds, of the
        ratio of both medians; and the least share of a round in which the thread had a core.
    """
    import numpy as np

    seconds = times.seconds
    ratios = np.median(seconds, 1) / np.median(base.seconds, 1)
    return {
        f"{prefix}median_ms": 1000 * float(np.median(seconds)),
        f"{prefix}p95_ms": 1000 * float(np.percentile(seconds, 95)),
        f"{prefix}ratio_to_avatar_poser": float(np.median(ratios)),
        f"{prefix}ratio_least": float(ratios.min()),
        f"{prefix}ratio_most": float(ratios.max()),
        f"{prefix}core_share": float(times.core_shares.min()),
    }


def least_core_share(row: dict[str, Any]) -> float:
    """Return the least share of a round, of steps or of poses, in which a row's thread had a core."""
    return min(row[key] for key in ("core_share", "pose_core_share") if key in row)


def busy(rows: list[dict[str, Any]]) -> str:
    """Return a line that names the rows that were timed while other work ran; empty if there are none.

    A long step is interrupted more often than a short one, so that other work is in their ratio, too.
    """
    from memmlp.common.thread_core_share import LEAST_CORE_SHARE
    from memmlp.tables.flag_words import had_core, listed

    found = [
        had_core(f"{row['model']} {row['variant']}", share)
        for row in rows
        if (share := least_core_share(row)) < LEAST_CORE_SHARE
    ]
    said = "timed on a busy machine, so that other work is in the times and ratios"
    return f"{said}: {listed(found)}" if found else ""


def show(rows: list[dict[str, Any]], rounds: int) -> None:
    """Print the rows as a table of 80 columns, one line each."""
    from rich.console import Console
    from rich.table import Table

    print(f"milliseconds on one thread, {rounds} rounds in turn; x: of AvatarPoser's network, or of its pose")
    print("torch: AvatarPoser's network of torch's own layers, which checks the time of ours")
    print("core: the least % of a round in which the thread had a core")
    table = Table(box=None, pad_edge=False)
    for name in ("network", "graph"):
        table.add_column(name, no_wrap=True)
    for name in ("step", "p95", "x", "rounds", "pose", "x", "core"):
        table.add_column(name, justify="right", no_wrap=True)
    for r in rows:
        table.add_row(
            r["model"],
            r["variant"],
            *(short(r[key]) for key in ("median_ms", "p95_ms", "ratio_to_avatar_poser")),
            f"{short(r['ratio_least'])}-{short(r['ratio_most'])}",
            *(short(r[key]) if key in r else "" for key in ("pose_median_ms", "pose_ratio_to_avatar_poser")),
            f"{100 * least_core_share(r):.0f}",
        )
    Console().print(table)


def short(number: float) -> str:
    """Return a number in at most four characters, so that a row fits a line of 80."""
    return f"{number:.2f}" if number < 10 else f"{number:.1f}" if number < 100 else f"{number:.0f}"


def show_breakdown(path: Path) -> None:
    """Print where a step's time goes, by kind and shape of operation."""
    from rich.console import Console
    from rich.table import Table

    from memmlp.deploy.latency import profiled

    table = Table(title=f"{path.name.removesuffix('.onnx')}: microseconds a step", title_justify="left")
    table.add_column("operation")
    table.add_column("first input")
    for name in ("times", "us each", "us a step"):
        table.add_column(name, justify="right")
    for kind, shape, times, each in profiled(path)[:20]:
        table.add_row(kind, shape, f"{times:.0f}", f"{each:.1f}", f"{times * each:.0f}")
    Console().print(table)
