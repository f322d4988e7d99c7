"""`memmlp render`: runs beside the truth, coloured by error, as a figure or a film."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import outputs_option

if TYPE_CHECKING:
    import numpy as np

    from memmlp.cli.opened import Opened
    from memmlp.render.take import Take

SUFFIXES = (".png", ".gif", ".mp4")


@click.command("render")
@click.argument("runs", nargs=-1, required=True)
@click.option("--clip", help="A test clip's name.  [default: the first]")
@click.option(
    "--out", required=True, type=click.Path(path_type=Path, dir_okay=False), help="FILE.png, .gif or .mp4."
)
@click.option("--label", "labels", multiple=True, help="A run's label, once for each.  [default: its id]")
@click.option(
    "--branch", default="rotation", show_default=True, type=click.Choice(["rotation", "position"]),
    help="Forward kinematics of the rotations with the head on its tracker, or the positions as they are.",
)  # fmt: skip
@click.option("--mode", default="stream", show_default=True, type=click.Choice(["stream", "window"]))
@click.option(
    "--from", "begin", default=0.0, show_default=True, type=click.FloatRange(min=0), help="Seconds."
)
@click.option("--to", "end", type=click.FloatRange(min=0, min_open=True), help="Seconds.  [default: the end]")
@click.option(
    "--frames",
    default=6,
    show_default=True,
    type=click.IntRange(1, 20),
    help="Poses of a PNG, evenly spaced.",
)
@outputs_option
def render(
    runs: tuple[str, ...],
    clip: str | None,
    out: Path,
    labels: tuple[str, ...],
    branch: str,
    mode: str,
    begin: float,
    end: float | None,
    frames: int,
    outputs: Path,
) -> None:
    """The truth and finished RUNS (ids, their beginnings, or folders) on one test clip, coloured by error.

    A PNG has a row for each run and a column for each pose; a GIF or MP4 has them side by side at 30
    pictures a second. One colour scale holds for all.
    """
    from memmlp.cli.opened import opened
    from memmlp.render.figure import heatmap_png
    from memmlp.render.film import film, pyav

    check(out, runs, labels)
    if out.suffix == ".mp4":
        pyav()
    take = taken([opened(outputs, run) for run in runs], labels, clip, branch, mode)
    take = cut(take, begin, end)
    if out.suffix == ".png":
        heatmap_png(out, take, frames)
    else:
        film(out, take)
    errors = ", ".join(f"{label} {error.mean():.1f} cm" for label, error in take.errors.items())
    click.echo(f"{out}: {take.title}, {errors}")


def check(out: Path, runs: tuple[str, ...], labels: tuple[str, ...]) -> None:
    """Raise InputError for what is wrong before any run is read."""
    from memmlp.errors import InputError

    if out.suffix not in SUFFIXES:
        raise InputError(f"--out {out}: no such kind of picture; allowed are {', '.join(SUFFIXES)}")
    if not out.parent.is_dir():
        raise InputError(f"--out {out}: there is no folder {out.parent}")
    if labels and len(labels) != len(runs):
        raise InputError(f"--label: {len(labels)} for {len(runs)} runs; allowed is one for each, or none")
    if len(set(labels or runs)) < len(runs):
        raise InputError(f"{'--label' if labels else 'RUNS'}: one is there twice; allowed are different ones")


def taken(runs: list[Opened], labels: tuple[str, ...], clip: str | None, branch: str, mode: str) -> Take:
    """The whole clip as these runs predict it."""
    import numpy as np

    from memmlp.errors import InputError
    from memmlp.render.take import Take

    title = clip or runs[0].test.names[0]
    truths, predictions = [], {}
    for label, run in zip(labels or [run.run.id[:8] for run in runs], runs, strict=True):
        truth, predictions[label] = predicted(run, title, branch, mode)
        truths.append(truth)
        if truth.shape != truths[0].shape or not np.array_equal(truth, truths[0]):
            raise InputError(
                f"run {run.run.id}: {title} is another motion or body there than in the first run"
            )
    return Take(title, truths[0], predictions)


def predicted(run: Opened, clip: str, branch: str, mode: str) -> tuple[np.ndarray, np.ndarray]:
    """Truth and prediction (N, 22, 3) of a test clip, metres, world."""
    from memmlp import evaluation
    from memmlp.body import SPARSE_DIM
    from memmlp.cli.opened import clip_index

    model = run.experiment.architecture.load(run.run)
    frames = run.test.clip(clip_index(run.test, clip))
    motion = evaluation.MODES[mode](model, [frames])[0]
    positions = {
        "rotation": lambda: model.frame.pose(motion, frames[:, :SPARSE_DIM]),
        "position": lambda: evaluation.joint_positions(motion),
    }[branch]()
    return evaluation.joint_positions(frames[:, SPARSE_DIM:]).numpy(), positions.numpy()


def cut(take: Take, begin: float, end: float | None) -> Take:
    """The piece of a clip between two times, seconds."""
    from dataclasses import replace

    from memmlp.body import FPS
    from memmlp.errors import InputError

    length = len(take.truth)
    first, last = round(begin * FPS), length if end is None else min(round(end * FPS), length)
    if first >= last:
        given = f"--from {begin:g}" + ("" if end is None else f" --to {end:g}")
        raise InputError(f"{given}: nothing between; {take.title} has {length / FPS:.1f} s")
    pieces = {label: motion[first:last] for label, motion in take.predictions.items()}
    return replace(take, truth=take.truth[first:last], predictions=pieces, start=first)
