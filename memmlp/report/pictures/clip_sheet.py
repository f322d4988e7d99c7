"""A sheet of motion clips, each at a few moments."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from memmlp.common.errors import InputError
from memmlp.motion.body import load_rest_joints
from memmlp.motion.clip import Skipped
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.geometry import clip_kinematics
from memmlp.motion.preparing.find_clips import clip_name, find_clips
from memmlp.report.pictures.drawing import Camera, draw_skeleton, fix_layout, make_panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ACROSS, MOMENTS = 4, 3  # clips beside each other, moments of each
NAME = 48  # the most characters of a name
METRES, LENS = 2.2, 1.0  # height that a panel covers, and that the camera looks at, metres
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


def draw_sheet(clips: Sequence[tuple[str, np.ndarray]]) -> Figure:
    """Draw clips side by side, each at three evenly spread moments.

    Args:
        clips: name and global joint positions (N, 22, 3), metres, world (Z up, the floor at 0), of each.
    """
    rows = -(-len(clips) // ACROSS)
    figure, panels = make_panels(150 * ACROSS * MOMENTS, 246 * rows, rows, ACROSS * MOMENTS)
    shown = list(zip(panels.reshape(-1, MOMENTS), clips, strict=False))
    for row, (name, _) in shown:
        row[1].set_title(name if len(name) <= NAME else f"…{name[1 - NAME :]}", size=9)
    fix_layout(figure)
    for row, (_, joints) in shown:
        for moment, panel in enumerate(row):
            frame = (2 * moment + 1) * len(joints) // (2 * MOMENTS)
            draw_skeleton(panel, _camera(joints[frame]), joints[frame])
    return figure


def _camera(joints: np.ndarray) -> Camera:
    left = joints[1] - joints[2]  # from right to left hip
    return Camera(np.array([*joints[0, :2], LENS]), np.arctan2(left[1], left[0]) + SIDE, METRES)
