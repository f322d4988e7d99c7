"""`memmlp render`: draw predictions of runs beside the ground truth, coloured by error."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import FiniteFloat, HomePath, add_run_options, check_runs_exist, warn_about_training
from memmlp.common.errors import InputError
from memmlp.common.progress import announce

if TYPE_CHECKING:
    from memmlp.config.open_run import OpenedRun
    from memmlp.report.pictures.clip_pictures import ClipPiece

POSITIONS = {"rotation": "predicted_positions", "position": "predicted_positions_of_position_branch"}


@click.command("render")
@click.argument("runs", nargs=-1, required=True)
@click.option("--clip", help="Name of the test clip to draw.  [default: the first test clip]")
@click.option(
    "--out",
    required=True,
    type=HomePath(dir_okay=False),
    help="File to write: a figure (.svg, .png) or a film (.gif, .mp4).",
)
@click.option(
    "--label",
    "labels",
    multiple=True,
    help="Label of a run; repeat the option for each run, in the order of RUNS.  [default: run ids]",
)
@click.option(
    "--branch",
    default="rotation",
    type=click.Choice(["rotation", "position"]),
    help="Branch to draw: rotation (forward kinematics with the head at its tracker), or position (the "
    "network's predicted positions).",
)
@click.option("--mode", default="stream", type=click.Choice(["stream", "window"]))
@click.option("--from", "begin", default=0.0, type=FiniteFloat(min=0), help="Start of the piece, seconds.")
@click.option(
    "--to",
    "end",
    type=FiniteFloat(min=0, min_open=True),
    help="End of the piece, seconds.  [default: the clip's end]",
)
@click.option(
    "--poses", default=6, type=click.IntRange(1, 20), help="Number of evenly spaced poses in a PNG."
)
@add_run_options
def render(
    runs: tuple[str, ...],
    clip: str | None,
    out: Path,
    labels: tuple[str, ...],
    branch: str,
    mode: str,
    begin: float,
    end: float | None,
    poses: int,
    outputs: Path,
) -> None:
    """Draw predictions of finished RUNS beside the ground truth of a test clip, coloured by error.

    RUNS are ids, beginnings of ids, folders, or shipped networks. A PNG has a row for each run and a column
    for each pose. A GIF or MP4 shows the runs side by side at 30 frames per second. All runs share one colour
    scale.
    """
    check_runs_exist(outputs, *runs)
    from memmlp.config.open_run import open_run
    from memmlp.report.pictures.clip_pictures import check_picture_path, write_picture

    check_picture_path(out, "--out")
    if labels and len(labels) != len(runs):
        raise InputError(f"--label: {len(labels)} labels for {len(runs)} runs; give one for each, or none")
    opened = [open_run(outputs, run) for run in runs]
    names = labels or tuple(run.run.id[:8] for run in opened)
    if len(set(names)) < len(names):
        raise InputError(f"{'--label' if labels else 'RUNS'}: must differ from each other")
    piece = _predict_piece(dict(zip(names, opened, strict=True)), clip, begin, end, branch, mode)
    announce(f"render: draw {out}")
    write_picture(out, piece, poses, "--out")
    errors = ", ".join(f"{label} {error.mean():.1f} cm" for label, error in piece.errors.items())
    click.echo(f"{out}: {piece.title}, {errors}")
    warn_about_training(*(one.run for one in opened))


def _predict_piece(
    runs: dict[str, OpenedRun], clip: str | None, begin: float, end: float | None, branch: str, mode: str
) -> ClipPiece:
    """Return a clip between two times in seconds, with the runs' predictions by label."""
    import numpy as np

    from memmlp.config.open_run import find_clip
    from memmlp.evaluation.predictions import predict_clip
    from memmlp.report.pictures.clip_pictures import ClipPiece, find_frame_range

    first_run = next(iter(runs.values()))
    title = clip or first_run.test.names[0]
    length = len(find_clip(first_run.test, title))
    first, last = find_frame_range(length, title, begin, end, ("--from", "--to"))
    truths, predictions = [], {}
    for label, run in runs.items():
        announce(f"render: {label} on {title}")
        frames = find_clip(run.test, title)
        if mode == "stream":  # a stream does not use later frames; windows may
            frames = frames[:last]
        arrays = predict_clip(run.network(), frames, mode)
        truths.append(arrays["true_positions"][first:last])
        predictions[label] = arrays[POSITIONS[branch]][first:last]
        if not np.array_equal(truths[-1], truths[0]):
            raise InputError(f"run {run.run.id}: the motion or body of {title} differs from the first run")
    return ClipPiece(f"{title} ({mode}, {branch})", truths[0], predictions, start=first)
