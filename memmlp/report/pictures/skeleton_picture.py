"""A picture that compares a file's skeleton, with its mapped nodes, to the built-in body."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from memmlp.common.files import atomic_write
from memmlp.motion.importing.convert import StanceView
from memmlp.motion.importing.skeleton_map import Z_UP, strip_namespace
from memmlp.motion.limb_shapes import RADII
from memmlp.report.pictures.drawing import Camera, draw_skeleton, encode_png, freeze_layout, make_panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes

METRES = 1.95  # height of a view's visible area
LEFT, RIGHT, MIDDLE, UNMAPPED = "#1f6fd0", "#d0561f", "#2a8c4a", "#b4bac1"


def write_skeleton_picture(path: Path, stance: StanceView, title: str) -> None:
    """Write a PNG with front and right views of the file's nodes and of the body in the same stance.

    Mapped nodes are coloured and numbered, and a list shows their names. Other nodes are grey.
    """
    figure, panels = make_panels(1700, 440, 1, 5)
    figure.suptitle(f"{title}, read from {stance.source}", x=0.01, ha="left", weight="bold")
    labels = ("", "the file, from the front", "from the right", "the body in this stance", "from the right")
    for panel, label in zip(panels[0], labels, strict=True):
        panel.set_xlabel(label)
    freeze_layout(figure)
    names, front, side, body_front, body_side = panels[0]
    nodes = strip_namespace(stance.nodes)
    for row, (joint, node) in enumerate(
        sorted(stance.mapped.items(), key=lambda one: find_joint_colour(one[0]))
    ):
        text = f"{node}  {joint} = {nodes[node]}"
        names.text(0, 0.96 - row / 23, text, color=find_joint_colour(joint), size=9)
    _draw_nodes(front, stance, 0)
    _draw_nodes(side, stance, 2)
    joints = stance.body @ Z_UP.T
    joints = joints - [0, 0, joints[:, 2].min() - min(RADII)]
    centre = np.array([*joints[:, :2].mean(0), METRES / 2 - 0.08])
    draw_skeleton(body_front, Camera(centre, 0.0, METRES, np.deg2rad(4)), joints)
    draw_skeleton(body_side, Camera(centre, -np.pi / 2, METRES, np.deg2rad(4)), joints)
    atomic_write(path, encode_png(figure))


def find_joint_colour(joint: str) -> str:
    """Return the colour of a body joint: one for the left side, one for the right, one for the middle."""
    return {"left": LEFT, "right": RIGHT}.get(joint.split("_")[0], MIDDLE)


def _draw_nodes(panel: Axes, stance: StanceView, axis: int) -> None:
    """Draw all nodes with lines to their parents. The given coordinate axis points right.

    The panel shows the area around the mapped nodes, because a root node may be far from the person.
    """
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
    reach = max(np.ptp(mapped, axis=0).max(), METRES) / 2
    panel.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
