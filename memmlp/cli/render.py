"""`memmlp render`: predictions of runs beside the truth, coloured by error, as a figure or a film."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import Finite, check_runs, outputs_option, plugins_option
from memmlp.cli.run_remarks import remark_on

if TYPE_CHECKING:
    import numpy as np

    from memmlp.config.open_run import OpenedRun
    from memmlp.render.clip_piece import ClipPiece

POSITIONS = {"rotation": "predicted_positions", "position": "predicted_positions_of_position_branch"}


@click.command("render")
@click.argument("runs", nargs=-1, required=True)
@click.option("--clip", help="Name of the test clip to draw.  [default: the first one]")
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path, dir_okay=False),
    help="File to write: a figure (.png) or a film (.gif, .mp4).",
)
@click.option(
    "--label",
    "labels",
    multiple=True,
    help="Label of a run in the picture; given once for each run, in order.  [default: its id]",
)
@click.option(
    "--branch", default="rotation", show_default=True, type=click.Choice(["rotation", "position"]),
    help="Branch whose joints are drawn: rotation, by forward kinematics with the head on its tracker, or "
    "position, as the network gives them.",
)  # fmt: skip
@click.option("--mode", default="stream", show_default=True, type=click.Choice(["stream", "window"]))
@click.option(
    "--from",
    "begin",
    default=0.0,
    show_default=True,
    type=Finite(min=0),
    help="Time at which the piece begins, seconds.",
)
@click.option(
    "--to",
    "end",
    type=Finite(min=0, min_open=True),
    help="Time at which the piece ends, seconds.  [default: the clip's end]",
)
@click.option(
    "--poses",
    "frames",
    default=6,
    show_default=True,
    type=click.IntRange(1, 20),
    help="How many poses a PNG shows, evenly spaced over the piece.",
)
@plugins_option
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
    check_runs(outputs, *runs)
    from memmlp.common.progress import tell
    from memmlp.config.open_run import open_run
    from memmlp.render.figure_or_film import check_picture, write_picture

    check_picture(out, "--out")
    check_labels(runs, labels)
    opened = [open_run(outputs, run) for run in runs]
    piece = piece_of(opened, labels, clip, (begin, end), branch, mode)
    tell(f"render: draw {out}")
    write_picture(out, piece, frames, "--out")
    errors = ", ".join(f"{label} {error.mean():.1f} cm" for label, error in piece.errors.items())
    click.echo(f"{out}: {piece.title}, {errors}")
    remark_on(one.run for one in opened)


def check_labels(runs: tuple[str, ...], labels: tuple[str, ...]) -> None:
    """Raise InputError unless there is one label for each run, or none at all."""
    from memmlp.common.errors import InputError

    if labels and len(labels) != len(runs):
        raise InputError(f"--label: {len(labels)} for {len(runs)} runs; allowed is one for each, or none")


def piece_of(
    runs: list[OpenedRun],
    labels: tuple[str, ...],
    clip: str | None,
    times: tuple[float, float | None],
    branch: str,
    mode: str,
) -> ClipPiece:
    """Return the piece of a clip between two times, with these runs' predictions.

    Args:
        runs: the opened runs.
        labels: a label for each run; empty for their ids.
        clip: the test clip's name; None for the first.
        times: begin and end of the piece, seconds; None for the clip's end.
        branch: "rotation" (forward kinematics, with the head on its tracker) or "position".
        mode: "stream" or "window".

    Raises:
        InputError: if labels repeat, the piece is empty, or the runs have different truths for the clip.
    """
    import numpy as np

    from memmlp.common.errors import InputError
    from memmlp.common.progress import tell
    from memmlp.config.open_run import clip_of
    from memmlp.render.clip_piece import ClipPiece, span

    names = labels or tuple(run.run.id[:8] for run in runs)
    if len(set(names)) < len(names):
        raise InputError(f"{'--label' if labels else 'RUNS'}: one is there twice; allowed are different ones")
    title = clip or runs[0].test.names[0]
    first, last = span(len(clip_of(runs[0].test, title)), title, *times, ("--from", "--to"))
    truths, predictions = [], {}
    for label, run in zip(names, runs, strict=True):
        tell(f"render: {label} on {title}")
        truth, motion = predicted(run, title, last, branch, mode)
        truths.append(truth[first:])
        predictions[label] = motion[first:]
        if not np.array_equal(truths[-1], truths[0]):
            raise InputError(
                f"run {run.run.id}: {title} is another motion or body there than in the first run"
            )
    return ClipPiece(f"{title} ({mode}, {branch})", truths[0], predictions, start=first)


def predicted(run: OpenedRun, clip: str, last: int, branch: str, mode: str) -> tuple[np.ndarray, np.ndarray]:
    """Return truth and prediction (last, 22, 3) of a test clip's first `last` frames, metres, world."""
    from memmlp.config.open_run import clip_of
    from memmlp.evaluation.predictions import predict_clip

    frames = clip_of(run.test, clip)
    if mode == "stream":  # a stream sees no later frames; windows may
        frames = frames[:last]
    arrays = predict_clip(run.network(), frames, mode)
    return arrays["true_positions"][:last], arrays[POSITIONS[branch]][:last]
