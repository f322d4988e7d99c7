"""`memmlp bench latency`: a step of each network as it was trained, as its stream, in fp16 and in int8."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from memmlp.cli.options import config_dir_option, plugins_option

if TYPE_CHECKING:
    import numpy as np

BASE = ("avatar_poser", "naive")
"""The network and graph that the others are compared with: AvatarPoser as published."""

MODELS: dict[str, tuple[str, ...]] = {
    "avatar_poser": ("model=avatar_poser",),
    "agrol_mlp_196": ("model=agrol_mlp",),
    "agrol_mlp_41": ("model=agrol_mlp", "model.frames=41"),
    "agrol_diffusion": ("model=agrol_diffusion", "model.sampling_steps=5"),
    "bodiffusion": ("model=bodiffusion",),
    "mem_mlp_41": (),
    "mem_mlp_60": ("model.frames=60",),
    "ego_poser": ("model=ego_poser",),
    "hmd_poser": ("model=hmd_poser",),
    "vae_hmd": ("model=vae_hmd",),
    "rpm": ("model=rpm",),
    "manikin_s": ("model=manikin_s",),
    "avatar_jlm": ("model=avatar_jlm",),
    "manikin_l": ("model=manikin_l",),
    "sage": ("model=sage",),
}
SLOW = ("bodiffusion", "avatar_jlm", "manikin_l", "sage")
"""Seconds a step, or gigabytes of files: timed where they are asked for."""
VARIANTS = ("naive", "streaming", "fp16", "int8")


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
    "--json", "file", type=click.Path(path_type=Path), help="File to write the measured rows into, as JSON."
)
@click.option(
    "--profile",
    help="Show instead where the time of one network goes: NETWORK:VARIANT, such as mem_mlp_41:int8.",
)
@click.argument("overrides", nargs=-1)
@config_dir_option
@plugins_option
def latency(
    rounds: int, steps: int, models: str, file: Path | None, profile: str | None, overrides: tuple[str, ...]
) -> None:
    """Time a step of every network.

    All run in ONNX Runtime, in turn in one process, on one thread; and of each a whole pose, from a sample of
    the trackers to the joints. OVERRIDES are those of `memmlp train`; the
    default is profile=paper. Weights are random: they do not matter for the time. The ratio is to AvatarPoser
    as published, of each round's medians.
    """
    import tempfile

    from memmlp.common.errors import InputError

    chosen = [name.strip() for name in models.split(",")]
    allowed = [f"{name}:{variant}" for name in MODELS for variant in VARIANTS]
    if not set(chosen) <= set(MODELS) or BASE[0] not in chosen:
        raise InputError(
            f"--models {models}: allowed are {', '.join(MODELS)}, with {BASE[0]} for the comparison"
        )
    if profile and profile not in allowed:
        raise InputError(f"--profile {profile}: allowed are {', '.join(allowed)}")
    if file and not file.absolute().parent.is_dir():
        raise InputError(f"--json {file}: there is no folder {file.parent}")
    with tempfile.TemporaryDirectory() as folder:
        paths = dict(exported(chosen, overrides, Path(folder)))
        rows = timed(paths, rounds, steps)
        show(rows, rounds)
        if file:
            from memmlp.common.files import write_json

            write_json(file, rows)
        if profile:
            name, variant = profile.split(":")
            show_profile(paths[name, variant])


def exported(
    models: list[str], overrides: tuple[str, ...], folder: Path
) -> Iterator[tuple[tuple[str, str], Path]]:
    """Export each model in all variants, with a progress bar, and yield (model, variant) with the file."""
    from memmlp.common.progress import progress_bar
    from memmlp.config.build import untrained
    from memmlp.deploy.export import export
    from memmlp.deploy.half import halve
    from memmlp.deploy.quantization import quantise
    from memmlp.networks.streaming import streaming

    clips = calibration_clips()
    for name in progress_bar(models, "exporting"):
        model = untrained(("profile=paper", *overrides, *MODELS[name]))
        paths = {variant: folder / f"{name}.{variant}.onnx" for variant in VARIANTS}
        stream = streaming(model)
        export(model, paths["naive"], "random")
        export(stream, paths["streaming"], "random")
        halve(paths["streaming"], paths["fp16"], stream.ends)
        quantise(paths["streaming"], paths["int8"], stream.ends, clips)
        for variant, path in paths.items():
            yield (name, variant), path


def calibration_clips() -> list[Any]:
    """Return one short clip (60, 252) of random frames to calibrate int8 with."""
    import torch

    from memmlp.motion.body import FRAME_DIM

    return [0.1 * torch.randn(60, FRAME_DIM, generator=torch.Generator().manual_seed(0))]


def timed(paths: dict[tuple[str, str], Path], rounds: int, steps: int) -> list[dict[str, Any]]:
    """Time all files in turn, and return a row for each.

    A row has the median and 95th percentile in milliseconds, the ratio to AvatarPoser and its spread, and the
    median of a whole pose.
    """
    import numpy as np

    from memmlp.deploy.latency import interleaved
    from memmlp.live.latency import measure_pose

    seconds = interleaved(paths, rounds, steps)
    base = np.median(seconds[BASE], 1)
    return [
        row(model, variant, times, np.median(times, 1) / base) | measure_pose(paths[model, variant], steps)
        for (model, variant), times in seconds.items()
    ]


def row(model: str, variant: str, seconds: np.ndarray, ratios: np.ndarray) -> dict[str, Any]:
    """Make a file's row.

    Args:
        model: the model's name.
        variant: one of VARIANTS.
        seconds: the time of each step (rounds, steps).
        ratios: each round's median over the median of `BASE` in that round (rounds,).
    """
    import numpy as np

    return {
        "model": model,
        "variant": variant,
        "median_ms": 1000 * float(np.median(seconds)),
        "p95_ms": 1000 * float(np.percentile(seconds, 95)),
        "ratio_to_avatar_poser": float(np.median(ratios)),
        "ratio_least": float(ratios.min()),
        "ratio_most": float(ratios.max()),
    }


def show(rows: list[dict[str, Any]], rounds: int) -> None:
    """Print the rows as a table."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"one step on one thread, {rounds} rounds in turn", title_justify="left")
    for name in ("network", "graph"):
        table.add_column(name)
    for name in ("median ms", "p95 ms", "to AvatarPoser", "over rounds", "whole pose ms"):
        table.add_column(name, justify="right")
    for r in rows:
        table.add_row(
            r["model"],
            r["variant"],
            f"{r['median_ms']:.2f}",
            f"{r['p95_ms']:.2f}",
            f"{r['ratio_to_avatar_poser']:.2f}",
            f"{r['ratio_least']:.2f} to {r['ratio_most']:.2f}",
            f"{r['pose_median_ms']:.2f}",
            end_section=r["variant"] == VARIANTS[-1],
        )
    Console().print(table)


def show_profile(path: Path) -> None:
    """Print where a step's time goes, by the kind of operation and its shape."""
    from rich.console import Console
    from rich.table import Table

    from memmlp.deploy.latency import profile

    table = Table(title=f"{path.name.removesuffix('.onnx')}: microseconds a step", title_justify="left")
    table.add_column("operation")
    table.add_column("first input")
    for name in ("times", "us each", "us a step"):
        table.add_column(name, justify="right")
    for kind, shape, times, each in profile(path)[:20]:
        table.add_row(kind, shape, f"{times:.0f}", f"{each:.1f}", f"{times * each:.0f}")
    Console().print(table)
