"""A sheet of motion clips, each at a few moments: what an import or a data set looks like at one glance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from memmlp.render.raster import Camera, draw
from memmlp.render.sheet import Sheet

WIDTH, HEIGHT, LABEL, COLUMNS = 150, 220, 26, 12  # pixels; panels a row
SCALE = 100.0  # pixels a metre
LENS = 1.0  # metres above the floor that the camera looks at
ASKEW = np.deg2rad(35)  # the camera stands beside the person's front


def clip_sheet(clips: Sequence[tuple[str, np.ndarray]], moments: int = 3) -> np.ndarray:
    """Draw clips side by side, each at evenly spread moments.

    Args:
        clips: name and global joint positions (N, 22, 3), metres, world (Z up, the floor at 0), of each.
        moments: pictures of each clip.

    Returns:
        The picture (height, width, 3), uint8.
    """
    across = max(1, COLUMNS // moments)
    rows = -(-len(clips) // across)
    sheet = Sheet(across * moments * WIDTH, rows * (HEIGHT + LABEL))
    for index, (name, joints) in enumerate(clips):
        left, top = index % across * moments * WIDTH, index // across * (HEIGHT + LABEL)
        sheet.text(left + moments * WIDTH / 2, top + LABEL / 2, _short(name), 13)
        for moment in range(moments):
            frame = (2 * moment + 1) * len(joints) // (2 * moments)
            panel = sheet.panel(left + moment * WIDTH, top + LABEL, WIDTH, HEIGHT)
            panel.set_data(draw(_camera(joints[frame]), joints[frame], None, 0.0))
    return sheet.pixels()


def _short(name: str, most: int = 48) -> str:
    return name if len(name) <= most else "…" + name[1 - most :]


def _camera(joints: np.ndarray) -> Camera:
    """Return a camera beside the front of a person whose left hip is joint 1 and right hip joint 2."""
    left = joints[1] - joints[2]
    centre = np.array([*joints[0, :2], LENS])
    return Camera(centre, np.arctan2(left[1], left[0]) + ASKEW, WIDTH, HEIGHT, SCALE)
