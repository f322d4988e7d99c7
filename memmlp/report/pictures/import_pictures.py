"""Pictures of imported data: a file's skeleton beside the built-in body, and poses from several clips."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write
from memmlp.motion.body import RADII, load_rest_joints
from memmlp.motion.clip import SkippedFile
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.geometry import compute_clip_kinematics
from memmlp.motion.importing.convert import StanceView
from memmlp.motion.importing.skeleton_map import Z_UP, strip_namespace
from memmlp.motion.preparing.find_clips import find_clips, get_clip_name
from memmlp.report.pictures.drawing import Camera, draw_skeleton, encode_png, freeze_layout, make_panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ACROSS, MOMENTS = 4, 3  # number of clips in a row, and of poses from each clip
NAME = 48  # maximum number of characters of a name
METRES, LENS = 2.2, 1.0  # height of a panel's visible area, and height of its centre, metres
SIDE = np.deg2rad(35)  # the camera's angle from the person's front, radians


def read_sample(
    source: Path, count: int, body: str = "builtin"
) -> tuple[list[tuple[str, np.ndarray]], list[SkippedFile], int]:
    """Read an npz file, or `count` files from a folder, evenly spaced in the order of their names. Return
    name and global joint positions (N, 22, 3), metres, world, of each clip; the skipped files; and the number
    of all files. Raises InputError if the folder has no npz files, or no file could be read."""
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
    """Draw clips side by side, each with three evenly spaced poses, given names and global joint positions
    (N, 22, 3), metres, world (Z up, floor at 0)."""
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


SKELETON_METRES = 1.95  # height of a view's visible area
LEFT, RIGHT, MIDDLE, UNMAPPED = "#1f6fd0", "#d0561f", "#2a8c4a", "#b4bac1"


def write_skeleton_picture(path: Path, stance: StanceView, title: str) -> None:
    """Write a PNG with front and right views of the file's nodes and of the body in the same stance. Mapped
    nodes are coloured and numbered, and a list shows their names. Other nodes are grey."""
    figure, panels = make_panels(1700, 440, 1, 5)
    figure.suptitle(f"{title}, read from {stance.source}", x=0.01, ha="left", weight="bold")
    labels = ("", "the file, from the front", "from the right", "the body in this stance", "from the right")
    for panel, label in zip(panels[0], labels, strict=True):
        panel.set_xlabel(label)
    freeze_layout(figure)
    names, front, side, body_front, body_side = panels[0]
    nodes = strip_namespace(stance.nodes)
    for row, joint in enumerate(sorted(stance.mapped, key=find_joint_colour)):
        node = stance.mapped[joint]
        text = f"{node}  {joint} = {nodes[node]}"
        names.text(0, 0.96 - row / 23, text, color=find_joint_colour(joint), size=9)
    _draw_nodes(front, stance, 0)
    _draw_nodes(side, stance, 2)
    joints = stance.body @ Z_UP.T
    joints = joints - [0, 0, joints[:, 2].min() - min(RADII)]
    centre = np.array([*joints[:, :2].mean(0), SKELETON_METRES / 2 - 0.08])
    draw_skeleton(body_front, Camera(centre, 0.0, SKELETON_METRES, np.deg2rad(4)), joints)
    draw_skeleton(body_side, Camera(centre, -np.pi / 2, SKELETON_METRES, np.deg2rad(4)), joints)
    atomic_write(path, encode_png(figure))


def find_joint_colour(joint: str) -> str:
    """Return the colour of a body joint: one for the left side, one for the right, one for the middle."""
    return {"left": LEFT, "right": RIGHT}.get(joint.split("_")[0], MIDDLE)


def _draw_nodes(panel: Axes, stance: StanceView, axis: int) -> None:
    """Draw all nodes with lines to their parents. The given coordinate axis points right. The panel shows the
    area around the mapped nodes, because a root node may be far from the person."""
    mapped = stance.positions[list(stance.mapped.values())]
    places = (stance.positions - (mapped.min(0) + mapped.max(0)) / 2)[:, [axis, 1]]
    for node, parent in enumerate(stance.parents):
        if parent >= 0:
            panel.plot(*places[[parent, node]].T, color=UNMAPPED, lw=2, marker=".")
    for joint, node in stance.mapped.items():
        panel.plot(*places[node], color=find_joint_colour(joint), marker="o")
        panel.annotate(
            str(node), places[node], (4, 4), textcoords="offset points", size=8, annotation_clip=True
        )
    reach = max(np.ptp(mapped, axis=0).max(), SKELETON_METRES) / 2
    panel.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
