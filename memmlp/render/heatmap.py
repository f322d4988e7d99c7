"""Heat-map figures like the paper's Figs. 6 and 9 to 13: rows of truth and predictions, columns of poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from memmlp.common.files import atomic_write
from memmlp.common.progress import progress_bar
from memmlp.render.canvas import FAINT, Sheet, png
from memmlp.render.clip_piece import ClipPiece
from memmlp.render.raster import draw

POSES = 6
WIDTH, HEIGHT = 230, 330  # size of a panel, pixels
TOP, LEFT, RIGHT, CAPTION = 84, 40, 110, 26


def heatmap_png(path: Path, piece: ClipPiece, poses: int = POSES) -> None:
    """Write a PNG: the truth's poses in a row, and below it a row for each prediction, coloured by error.

    Each pose is seen from the person's front, by the same camera in all rows. The mean error of its 22 joints
    is written under a prediction.
    """
    rows = 1 + len(piece.predictions)
    step = HEIGHT + CAPTION
    sheet = Sheet(LEFT + poses * WIDTH + RIGHT, TOP + rows * step + 8)
    sheet.text(LEFT, 28, piece.title, 22, ha="left", weight="bold")
    for row, label in enumerate(["truth", *piece.predictions]):
        sheet.text(20, TOP + row * step + HEIGHT / 2, label, 17, rotation=90, weight="bold")
    frames = np.linspace(0, len(piece.truth) - 1, poses + 2).round().astype(int)[1:-1]
    for column, frame in enumerate(progress_bar(frames.tolist(), "poses")):
        x = LEFT + column * WIDTH
        sheet.text(x + WIDTH / 2, TOP - 16, f"{piece.seconds(frame):.2f} s", 17)
        for row, picture in enumerate(views(piece, frame)):
            sheet.panel(x, TOP + row * step, WIDTH, HEIGHT).set_data(picture)
        for row, errors in enumerate(piece.errors.values(), 2):
            mean = f"{errors[frame].mean():.1f} cm"
            sheet.text(x + WIDTH / 2, TOP + row * step - CAPTION + 10, mean, 16, color=FAINT)
    tall = min(360, rows * step - 40)
    sheet.colour_bar(LEFT + poses * WIDTH + 18, TOP + (rows * step - tall) // 2, 16, tall, piece.top)
    atomic_write(path, png(sheet.pixels()))


def views(piece: ClipPiece, frame: int) -> list[np.ndarray]:
    """Return the pictures of one column, the truth's first."""
    centre = piece.truth[frame, 0, :2]
    camera = piece.camera(piece.azimuth(frame), centre, WIDTH, HEIGHT)
    return [draw(camera, joints, errors, piece.floor) for joints, errors in piece.rows(frame)]


def poses_png(path: Path, truth: np.ndarray, predicted: np.ndarray, title: str) -> None:
    """Write a PNG of truth and prediction: joint positions (N, 22, 3), metres, world (Z up)."""
    heatmap_png(path, ClipPiece(title, truth, {"prediction": predicted}))
