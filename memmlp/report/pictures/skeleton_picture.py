"""A picture of a skeleton map: a file's stance with its mapped nodes beside the built-in body."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from memmlp.common.files import atomic_write
from memmlp.motion.importing.convert import StanceView
from memmlp.motion.importing.skeleton_map import Z_UP, without_namespace
from memmlp.motion.limb_shapes import RADII
from memmlp.report.pictures.canvas import FAINT, INK, Sheet, png, shorten
from memmlp.report.pictures.raster import Camera, draw

HEIGHT, TOP, BOTTOM = 700, 90, 50  # pixels
NAMES, FRONT, SIDE = 250, 480, 230  # widths of a column of names, of a front view, of a side view
WIDTH = 3 * NAMES + 2 * (FRONT + SIDE)
TALL, WIDE = 1.95, 1.9  # smallest height and width that a view covers, metres
SPACING = 21  # pixels from a name to the next
LEFT, RIGHT, MIDDLE, BARE = "#1f6fd0", "#d0561f", "#2a8c4a", "#b4bac1"


def write_skeleton_picture(path: Path, stance: StanceView, title: str) -> None:
    """Write a PNG of a stance from the front and from the right: the file's nodes, and the body.

    All nodes are grey; those mapped to a body joint are coloured, and named `body joint = node`.
    """
    sheet = Sheet(WIDTH, HEIGHT)
    sheet.text(24, 28, title, 20, ha="left", weight="bold")
    sheet.text(24, 58, f"read from {stance.source}", 15, ha="left", color=FAINT)
    mapped = stance.positions[list(stance.mapped.values())]
    positions, size = stance.positions - (mapped.min(0) + mapped.max(0)) / 2, np.ptp(mapped, axis=0)
    scale = float(min((HEIGHT - TOP - BOTTOM) / max(size[1], TALL), FRONT / max(size[0], WIDE)))
    front, side = NAMES + FRONT / 2, 2 * NAMES + FRONT + SIDE / 2 - 60
    places = _place(positions, front, 0, scale), _place(positions, side, 2, scale)
    for place, middle, width in zip(places, (front, side), (FRONT, SIDE), strict=True):
        _bones(sheet, stance, place, np.abs(place[:, 0] - middle) < width / 2 + 20)
    _names(sheet, stance, places[0], "right_", NAMES - 8, "right")
    _names(sheet, stance, places[0], "left_", NAMES + FRONT + 8, "left")
    _names(sheet, stance, places[1], "", side + SIDE / 2 + 20, "left")
    _body(sheet, stance)
    _legend(sheet, front, side)
    atomic_write(path, png(sheet.pixels()))


def _place(positions: np.ndarray, middle: float, axis: int, scale: float) -> np.ndarray:
    """Return the places (nodes, 2) of points (nodes, 3) in the picture, with the given axis to the right."""
    height = TOP + (HEIGHT - TOP - BOTTOM) / 2
    return np.stack([middle + scale * positions[:, axis], height - scale * positions[:, 1]], -1)


def _line(sheet: Sheet, points: np.ndarray, **style: Any) -> None:
    """Add a line through points (n, 2) of the picture."""
    from matplotlib.lines import Line2D

    x, y = points[:, 0] / sheet.width, 1 - points[:, 1] / sheet.height
    sheet.figure.add_artist(Line2D(x, y, **style))


def _colour(joint: str) -> str:
    return {"left": LEFT, "right": RIGHT}.get(joint.split("_")[0], MIDDLE)


def _bones(sheet: Sheet, stance: StanceView, places: np.ndarray, near: np.ndarray) -> None:
    """Draw all nodes grey, with lines to their parents, and the mapped ones in their colours.

    Nodes that are not `near` (nodes,) are left out: a root at the origin may be far from the person.
    """
    for node, parent in enumerate(stance.parents):
        if parent >= 0 and near[node] and near[parent]:
            _line(sheet, places[[parent, node]], color=BARE, lw=2, solid_capstyle="round")
    _line(sheet, places[near], color=BARE, lw=0, marker="o", ms=4)
    for joint, node in stance.mapped.items():
        _line(sheet, places[[node]], color=_colour(joint), lw=0, marker="o", ms=7)


def _names(sheet: Sheet, stance: StanceView, places: np.ndarray, side: str, x: float, align: str) -> None:
    """Write the names of one side's joints below each other, each joined to its node by a line."""
    joints = [joint for joint in stance.mapped if _colour(joint) == _colour(side or "pelvis")]
    joints.sort(key=lambda joint: places[stance.mapped[joint], 1])
    plain = without_namespace(stance.nodes)
    wanted = [float(places[stance.mapped[joint], 1]) for joint in joints]
    for joint, y in zip(joints, spread(wanted, SPACING, TOP, HEIGHT - BOTTOM), strict=True):
        node = stance.mapped[joint]
        end = x + (4 if align == "right" else -4)
        _line(sheet, np.array([[end, y], places[node]]), color=_colour(joint), lw=0.6, alpha=0.6)
        sheet.text(x, y, f"{joint} = {shorten(plain[node], 20)}", 14, ha=align, color=_colour(joint))


def spread(wanted: Sequence[float], least: float, low: float, high: float) -> list[float]:
    """Return rising places near the wanted ones, at least `least` apart and between two bounds.

    They are closer to each other only if there is not enough room.
    """
    least = min(least, (high - low) / max(1, len(wanted) - 1))
    places: list[float] = []
    for want in wanted:
        places.append(max(want, places[-1] + least if places else low))
    for index in reversed(range(len(places))):
        bound = high if index == len(places) - 1 else places[index + 1] - least
        places[index] = min(places[index], bound)
    return places


def _body(sheet: Sheet, stance: StanceView) -> None:
    """Draw the built-in body in the same stance, from the front and from the right."""
    joints = stance.body @ Z_UP.T
    joints = joints - [0, 0, joints[:, 2].min() - min(RADII)]
    room = HEIGHT - TOP - BOTTOM
    left = 3 * NAMES + FRONT + SIDE
    for azimuth, width in ((0.0, FRONT), (-np.pi / 2, SIDE)):
        centre = np.array([*joints[:, :2].mean(0), TALL / 2 - 0.08])
        camera = Camera(centre, azimuth, width, room, min(room / TALL, FRONT / WIDE), np.deg2rad(4))
        sheet.panel(left, TOP, width, room).set_data(draw(camera, joints, None, 0.0))
        left += width


def _legend(sheet: Sheet, front: float, side: float) -> None:
    y = HEIGHT - 24
    sheet.text(front, y, "the file, from the front", 15, color=INK)
    sheet.text(side, y, "from the right", 15, color=INK)
    body = 3 * NAMES + FRONT + SIDE
    sheet.text(body + FRONT / 2, y, "the body in this stance", 15, color=INK)
    sheet.text(body + FRONT + SIDE / 2, y, "from the right", 15, color=INK)
    for index, (word, colour) in enumerate(
        (("right", RIGHT), ("left", LEFT), ("middle", MIDDLE), ("not mapped", BARE))
    ):
        sheet.text(WIDTH - 440 + 100 * index, 28, f"● {word}", 15, ha="left", color=colour)
