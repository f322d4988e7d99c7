"""`memmlp render`: predictions of runs beside the truth, coloured by error, as a figure or a film."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import Finite, outputs_option

if TYPE_CHECKING:
    import numpy as np

    from memmlp.config.open_run import OpenedRun
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
@click.option("--from", "begin", default=0.0, show_default=True, type=Finite(min=0), help="Seconds.")
@click.option("--to", "end", type=Finite(min=0, min_open=True), help="Seconds.  [default: the end]")
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
    """Draw the truth and finished RUNS (ids, their beginnings, or folders) on a test clip, coloured by error.

    A PNG has a row for each run and a column for each pose; a GIF or MP4 has them side by side at 30 pictures
    a second. One colour scale holds for all.
    """
    from memmlp.common.errors import InputError
    from memmlp.config.open_run import open_run
    from memmlp.render.figure import heatmap_png
    from memmlp.render.film import film, pyav

    check(out, runs, labels)
    kind = out.suffix.lower()
    if kind == ".mp4":
        pyav()
    take = taken([open_run(outputs, run) for run in runs], labels, clip, (begin, end), branch, mode)
    try:
        if kind == ".png":
            heatmap_png(out, take, frames)
        else:
            film(out, take)
    except OSError as error:
        raise InputError(f"--out {out}: {error.strerror or error}") from None
    errors = ", ".join(f"{label} {error.mean():.1f} cm" for label, error in take.errors.items())
    click.echo(f"{out}: {take.title}, {errors}")


def check(out: Path, runs: tuple[str, ...], labels: tuple[str, ...]) -> None:
    """Raise InputError for options that are known to be wrong before any run is read."""
    from memmlp.common.errors import InputError

    if out.suffix.lower() not in SUFFIXES:
        raise InputError(f"--out {out}: no such kind of picture; allowed are {', '.join(SUFFIXES)}")
    if not out.parent.is_dir():
        raise InputError(f"--out {out}: there is no folder {out.parent}")
    if labels and len(labels) != len(runs):
        raise InputError(f"--label: {len(labels)} for {len(runs)} runs; allowed is one for each, or none")


def taken(
    runs: list[OpenedRun],
    labels: tuple[str, ...],
    clip: str | None,
    times: tuple[float, float | None],
    branch: str,
    mode: str,
) -> Take:
    """Return the piece of a clip between two times as these runs predict it.

    Args:
        runs: the opened runs.
        labels: a label for each run; empty for their ids.
        clip: the test clip's name; None for the first.
        times: begin and end of the piece, seconds; None for the clip's end.
        branch: "rotation" (forward kinematics, the head on its tracker) or "position".
        mode: "stream" or "window".

    Raises:
        InputError: where labels repeat, the piece is empty, or the runs have different truths for the clip.
    """
    import numpy as np

    from memmlp.common.errors import InputError
    from memmlp.config.open_run import clip_of
    from memmlp.render.take import Take

    names = labels or tuple(run.run.id[:8] for run in runs)
    if len(set(names)) < len(names):
        raise InputError(f"{'--label' if labels else 'RUNS'}: one is there twice; allowed are different ones")
    title = clip or runs[0].test.names[0]
    first, last = span(len(clip_of(runs[0].test, title)), title, *times)
    truths, predictions = [], {}
    for label, run in zip(names, runs, strict=True):
        truth, motion = predicted(run, title, last, branch, mode)
        truths.append(truth[first:])
        predictions[label] = motion[first:]
        if not np.array_equal(truths[-1], truths[0]):
            raise InputError(
                f"run {run.run.id}: {title} is another motion or body there than in the first run"
            )
    return Take(title, truths[0], predictions, start=first)


def predicted(run: OpenedRun, clip: str, last: int, branch: str, mode: str) -> tuple[np.ndarray, np.ndarray]:
    """Return truth and prediction (last, 22, 3) of a test clip's first `last` frames, metres, world."""
    from memmlp.config.open_run import clip_of
    from memmlp.evaluation import modes as evaluation
    from memmlp.motion.body import SPARSE_DIM

    model = run.experiment.architecture.load(run.run.weights())
    frames = clip_of(run.test, clip)
    if mode == "stream":  # a stream sees no later frames; windows may
        frames = frames[:last]
    motion = evaluation.MODES[mode](model, [frames])[0][:last]
    frames = frames[:last]
    positions = {
        "rotation": lambda: model.normalizer.pose(motion, frames[:, :SPARSE_DIM]),
        "position": lambda: evaluation.joint_positions(motion),
    }[branch]()
    return evaluation.joint_positions(frames[:, SPARSE_DIM:]).numpy(), positions.numpy()


def span(length: int, title: str, begin: float, end: float | None) -> tuple[int, int]:
    """Return a piece's first frame and the one after its last, for begin and end in seconds.

    Raises:
        InputError: where nothing lies between.
    """
    from memmlp.common.errors import InputError
    from memmlp.motion.body import FPS

    first, last = round(begin * FPS), length if end is None else min(round(end * FPS), length)
    if first >= last:
        given = f"--from {begin:g}" + ("" if end is None else f" --to {end:g}")
        raise InputError(f"{given}: nothing between; {title} has {length / FPS:.1f} s")
    return first, last
