"""A sheet of motion clips, each at a few moments."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from memmlp.common.errors import InputError
from memmlp.motion.body import load_rest_joints
from memmlp.motion.clip import Skipped
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.geometry import clip_kinematics
from memmlp.motion.preparing.find_clips import clip_name, find_clips
from memmlp.report.pictures.canvas import Sheet, shorten
from memmlp.report.pictures.raster import Camera, draw

WIDTH, HEIGHT, LABEL, COLUMNS = 150, 220, 26, 12  # pixels; panels a row
SCALE = 100.0  # pixels a metre
LENS = 1.0  # height that the camera looks at, metres
SIDE = np.deg2rad(35)  # the camera's angle from the person's front, radians


def read_sample(
    source: Path, count: int, body: str = "builtin"
) -> tuple[list[tuple[str, np.ndarray]], list[Skipped], int]:
    """Read a clip, or `count` of a folder's npz files, evenly spread in the order of their names.

    Returns:
        Name and global joint positions (N, 22, 3), metres, world, of each clip; the files that contain no
        clip; and the number of all files.

    Raises:
        InputError: if there are no npz files, or none that was read contains a clip.
    """
    rest = load_rest_joints(body)
    files = find_clips(source).files if source.is_dir() else [source.name]
    top = source if source.is_dir() else source.parent
    clips, skipped = [], []
    for index in np.unique(np.linspace(0, len(files) - 1, min(count, len(files))).round().astype(int)):
        file = files[index]
        try:
            clip = read_clip(top / file, clip_name(file))
        except InputError as error:
            skipped.append(Skipped(file, str(error).removeprefix(f"{top / file}: ")))
        else:
            clips.append((clip.name, clip_kinematics(clip, rest)[1]))
    if not clips:
        first = f"{skipped[0].file}: {skipped[0].reason}"
        raise InputError(f"{source}: no clip in {len(skipped)} files, the first: {first}")
    return clips, skipped, len(files)


def draw_sheet(clips: Sequence[tuple[str, np.ndarray]], moments: int = 3) -> np.ndarray:
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
        sheet.text(left + moments * WIDTH / 2, top + LABEL / 2, shorten(name, 48), 13)
        for moment in range(moments):
            frame = (2 * moment + 1) * len(joints) // (2 * moments)
            panel = sheet.panel(left + moment * WIDTH, top + LABEL, WIDTH, HEIGHT)
            panel.set_data(draw(_camera(joints[frame]), joints[frame], None, 0.0))
    return sheet.pixels()


def _camera(joints: np.ndarray) -> Camera:
    left = joints[1] - joints[2]  # from right to left hip
    centre = np.array([*joints[0, :2], LENS])
    return Camera(centre, np.arctan2(left[1], left[0]) + SIDE, WIDTH, HEIGHT, SCALE)
