"""Draws the pictures of docs/guides/engines.md: `python docs/engine_pictures.py` writes them to docs/images.

All are drawn in AMASS' world (Z up), where a person who looks forward looks along +Y and has the left at -X.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from memmlp.common.files import atomic_write
from memmlp.live.rotations import BodyTree
from memmlp.live.spaces import SPACES, Space
from memmlp.motion.body import JOINTS, PARENTS, RADII, TRACKED, make_builtin_rest_joints
from memmlp.report.pictures.drawing import Camera, draw_skeleton, encode_png, freeze_layout, make_panels
from memmlp.report.pictures.import_pictures import LEFT, MIDDLE, RIGHT, find_joint_colour

IMAGES = Path(__file__).parent / "images"
COLOURS = ("#d1242f", "#1a7f37", "#0969da")  # of X, Y and Z
TREE = BodyTree(make_builtin_rest_joints())
FACING = SPACES["openxr"].convert_rotations_to_amass(
    np.eye(3)
)  # the root of a person who stands and looks forward
RIGHTWARD, FORWARD, UP = np.eye(3)  # of that person
WIDTH, HEIGHT = 380, 466  # pixels of a panel
AZIMUTH = np.pi - 0.62


class Engine(NamedTuple):
    """A convention: what it is called, its X, Y and Z as a person sees them, and its unit.

    A person looks forward as figures do there.
    """

    name: str
    axes: tuple[np.ndarray, np.ndarray, np.ndarray]
    words: str

    @property
    def right_handed(self) -> bool:
        """Whether X x Y is Z."""
        return float(np.linalg.det(np.array(self.axes))) > 0


ENGINES = (
    Engine("amass", tuple(SPACES["amass"].world.T), "Z up, forward +Y, m"),
    Engine("openxr  (OpenXR, WebXR, Godot)", tuple(SPACES["openxr"].world.T), "Y up, forward -Z, m"),
    Engine("unity  (Unity)", tuple(SPACES["unity"].world.T), "Y up, forward +Z, m"),
    Engine("Blender", (-RIGHTWARD, -FORWARD, UP), "Z up, figures face -Y, m"),
    Engine("glTF, VRM 1.0, BVH", (-RIGHTWARD, UP, FORWARD), "Y up, figures face +Z, m (BVH: cm)"),
    Engine("Unreal", (FORWARD, RIGHTWARD, UP), "Z up, forward +X, cm"),
)


class View:
    """A panel with a body, onto which arrows and words can be drawn."""

    def __init__(self, panel: Axes, joints: np.ndarray, camera: Camera):
        self.panel, self.camera = panel, camera
        draw_skeleton(panel, camera, joints, floor=float((joints[:, 2] - np.array(RADII)).min()))

    def place(self, point: np.ndarray) -> np.ndarray:
        """Return where a point (3,) of the world is in the panel, metres."""
        return self.camera.project(point)[:2]

    def arrow(self, start: np.ndarray, end: np.ndarray, colour: str, word: str = "") -> None:
        """Draw an arrow between two points of the world, with a word beyond its head."""
        a, b = self.place(start), self.place(end)
        style = {"arrowstyle": "-|>", "lw": 2, "color": colour, "shrinkA": 0, "shrinkB": 0}
        self.panel.annotate("", b, a, arrowprops=style)
        beyond = b + 0.07 * (b - a) / max(float(np.hypot(*(b - a))), 0.05)
        self.panel.text(*beyond, word, color=colour, weight="bold", ha="center", va="center")

    def axes(self, origin: np.ndarray, axes: np.ndarray, length: float, words: str = "XYZ") -> None:
        """Draw X, Y and Z, the rows of `axes`, from a point, those farther away first."""
        depth = [float(self.camera.project(origin + axis)[2]) for axis in axes]
        for axis in np.argsort(depth):
            self.arrow(origin, origin + length * axes[axis], COLOURS[axis], words[axis : axis + 1])


def standing(local: np.ndarray | None = None) -> np.ndarray:
    """Return the joints (22, 3) of a person who looks forward, in T-pose or with local rotations."""
    turns = np.tile(np.eye(3), (len(JOINTS), 1, 1)) if local is None else local.copy()
    turns[0] = FACING @ turns[0]
    joints = TREE.compute_positions(turns)
    return joints - [0, 0, (joints[:, 2] - np.array(RADII)).min()]


def camera_on(joints: np.ndarray, azimuth: float = AZIMUTH, metres: float = 2.6) -> Camera:
    """Return a camera on the middle of a body."""
    return Camera((joints.min(0) + joints.max(0)) / 2, azimuth, metres, np.deg2rad(14))


def engines() -> Figure:
    """Draw a person and the axes of each convention."""
    joints = standing()
    figure, panels = make_panels(3 * WIDTH, 2 * HEIGHT, 2, 3)
    for panel, engine in zip(panels.flat, ENGINES, strict=True):
        hand = "right-handed" if engine.right_handed else "left-handed"
        panel.set_title(f"{engine.name}\n{hand}, {engine.words}")
    freeze_layout(figure)
    for panel, engine in zip(panels.flat, ENGINES, strict=True):
        view = View(panel, joints, camera_on(joints))
        view.axes(joints[0] * [1, 1, 0] + 0.75 * FORWARD, np.array(engine.axes), 0.42)
    return figure


def identities() -> Figure:
    """Draw the body all of whose rotations are the identity, in each space."""
    figure, panels = make_panels(3 * WIDTH, HEIGHT, 1, 3)
    for panel, name in zip(panels.flat, SPACES, strict=True):
        panel.set_title(f"{name}\n{LIES[name]}")
    freeze_layout(figure)
    for panel, space in zip(panels.flat, SPACES.values(), strict=True):
        joints = TREE.compute_positions(rooted(space, np.eye(3)))
        joints = joints - [0, 0, (joints[:, 2] - np.array(RADII)).min()]
        view = View(panel, joints, camera_on(joints))
        view.axes(joints[0] * [1, 1, 0] + np.array([0.75, 0.75, 0.0]), space.world.T, 0.4)
    return figure


LIES = {
    "amass": "lies on the back: Y is up in SMPL's body",
    "openxr": "stands, looks along -Z",
    "unity": "stands, looks along +Z",
}


def rooted(space: Space, root: np.ndarray) -> np.ndarray:
    """Return local rotations (22, 3, 3) as of AMASS, the root's from a space, the others the identity."""
    turns = np.tile(np.eye(3), (len(JOINTS), 1, 1))
    return space.convert_pose_to_amass(np.concatenate([root[None], turns[1:]]))


def trackers() -> Figure:
    """Draw the axes of head and wrists in T-pose, and in a pose, in the space openxr."""
    turn = {
        "head": Rotation.from_euler("yx", [35, 15], degrees=True),
        "left_shoulder": Rotation.from_euler("z", -70, degrees=True),
        "right_shoulder": Rotation.from_euler("z", 20, degrees=True),
        "right_elbow": Rotation.from_euler("y", 95, degrees=True),
    }
    posed = np.array([turn.get(name, Rotation.identity()).as_matrix() for name in JOINTS])
    still = np.tile(np.eye(3), (len(JOINTS), 1, 1))
    words = ("T-pose: all three rotations are the identity", "a pose: each rotation is the turn since then")
    figure, panels = make_panels(1140, 580, 1, 2)
    for panel, title in zip(panels.flat, words, strict=True):
        panel.set_title(title)
    freeze_layout(figure)
    for panel, local in zip(panels.flat, (still, posed), strict=True):
        joints, turns = standing(local), global_turns(local)
        view = View(panel, joints, camera_on(joints, metres=2.3))
        for joint in TRACKED:
            view.axes(joints[joint], SPACES["openxr"].world.T @ turns[joint].T, 0.26)
    return figure


def global_turns(local: np.ndarray) -> np.ndarray:
    """Return each joint's turn from the T-pose (22, 3, 3) of a standing person, in AMASS' world."""
    turns = local.copy()
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            turns[joint] = turns[parent] @ local[joint]
    return FACING @ turns @ FACING.T


def t_pose() -> Figure:
    """Draw the T-pose from the front with the joints' indices, and list their names."""
    joints = standing()
    figure, panels = make_panels(1160, 694, 1, 3)
    right, front, left = panels.flat
    front.set_xlabel("from the front: the person's left is on the right; ○ has a tracker")
    freeze_layout(figure)
    for panel, start, width in ((right, 0, 0.2), (front, 0.16, 0.66), (left, 0.84, 0.16)):
        panel.set_position((start, 0.06, width, 0.94))
    view = View(front, joints, camera_on(joints, np.pi, 2.0))
    for joint, point in enumerate(joints):
        x, y = view.place(point)
        if joint in TRACKED:
            front.plot(x, y, "o", ms=16, mfc="none", color="black")
        front.plot(x, y, "o", ms=5, color=find_joint_colour(JOINTS[joint]))
        front.annotate(str(joint), (x, y), (6, 6), textcoords="offset points", weight="bold")
    for panel, top, shown in ((right, 0.9, RIGHT), (left, 0.9, LEFT), (left, 0.4, MIDDLE)):
        for row, joint in enumerate(
            one for one in range(len(JOINTS)) if find_joint_colour(JOINTS[one]) == shown
        ):
            panel.text(0.05, top - 0.04 * row, f"{joint}  {JOINTS[joint]}", color=shown)
    return figure


PICTURES = {
    "engine_axes": engines, "engine_identity": identities, "engine_trackers": trackers,
    "engine_joints": t_pose,
}  # fmt: skip


def main() -> None:
    """Write all pictures."""
    for name, picture in PICTURES.items():
        atomic_write(IMAGES / f"{name}.png", encode_png(picture()))


if __name__ == "__main__":
    main()
