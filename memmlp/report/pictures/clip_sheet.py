"""A contact sheet: poses from several motion clips."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from memmlp.common.errors import InputError
from memmlp.motion.body import load_rest_joints
from memmlp.motion.clip import SkippedFile
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.geometry import compute_clip_kinematics
from memmlp.motion.preparing.find_clips import find_clips, get_clip_name
from memmlp.report.pictures.drawing import Camera, draw_skeleton, freeze_layout, make_panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ACROSS, MOMENTS = 4, 3  # number of clips in a row, and of poses from each clip
NAME = 48  # maximum number of characters of a name
METRES, LENS = 2.2, 1.0  # height of a panel's visible area, and height of its centre, metres
SIDE = np.deg2rad(35)  # the camera's angle from the person's front, radians


def read_sample(
    source: Path, count: int, body: str = "builtin"
) -> tuple[list[tuple[str, np.ndarray]], list[SkippedFile], int]:
    """Read an npz file, or `count` files from a folder, evenly spaced in the order of their names.

    Returns:
        Name and global joint positions (N, 22, 3), metres, world, of each clip; the skipped files; and the
        number of all files.

    Raises:
        InputError: if the folder has no npz files, or no file could be read.
    """
    rest = load_rest_joints(body)
    files = find_clips(source).files if source.is_dir() else [source.name]
    top = source if source.is_dir() else source.parent
    clips, skipped = [], []
    for index in np.unique(np.linspace(0, len(files) - 1, min(count, len(files))).round().astype(int)):
        file = files[index]
        try:
            clip = read_clip(top / file, get_clip_name(file))
        except InputError as error:
            skipped.append(SkippedFile(file, str(error).removeprefix(f"{top / file}: ")))
        else:
            clips.append((clip.name, compute_clip_kinematics(clip, rest)[1]))
    if not clips:
        first = f"{skipped[0].file}: {skipped[0].reason}"
        raise InputError(f"{source}: none of {len(skipped)} files could be read, for example {first}")
    return clips, skipped, len(files)


def draw_sheet(clips: Sequence[tuple[str, np.ndarray]]) -> Figure:
    """Draw clips side by side, each with three evenly spaced poses.

    Args:
        clips: pairs of name and global joint positions (N, 22, 3), metres, world (Z up, floor at 0).
    """
    rows = -(-len(clips) // ACROSS)
    figure, panels = make_panels(150 * ACROSS * MOMENTS, 246 * rows, rows, ACROSS * MOMENTS)
    shown = list(zip(panels.reshape(-1, MOMENTS), clips, strict=False))
    for row, (name, _) in shown:
        row[1].set_title(name if len(name) <= NAME else f"…{name[1 - NAME :]}", size=9)
    freeze_layout(figure)
    for row, (_, joints) in shown:
        for moment, panel in enumerate(row):
            frame = (2 * moment + 1) * len(joints) // (2 * MOMENTS)
            draw_skeleton(panel, _make_camera(joints[frame]), joints[frame])
    return figure


def _make_camera(joints: np.ndarray) -> Camera:
    left = joints[1] - joints[2]  # from right to left hip
    return Camera(np.array([*joints[0, :2], LENS]), np.arctan2(left[1], left[0]) + SIDE, METRES)
