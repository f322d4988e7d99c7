"""Draws the pictures of docs/guides/engines.md: `python docs/engine_pictures.py` writes them to docs/images.

All are drawn in AMASS' world (Z up), where a person who looks forward looks along +Y and has the left at -X.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.patches import FancyArrowPatch
from matplotlib.transforms import IdentityTransform
from scipy.spatial.transform import Rotation

from memmlp.common.files import atomic_write
from memmlp.live.rotations import BodyTree
from memmlp.live.spaces import SPACES, Space
from memmlp.motion.body import JOINTS, PARENTS, TRACKED, builtin_rest_joints
from memmlp.motion.limb_shapes import RADII
from memmlp.report.pictures.canvas import FAINT, INK, Sheet, png
from memmlp.report.pictures.raster import Camera, draw
from memmlp.report.pictures.skeleton_picture import LEFT, MIDDLE, RIGHT

IMAGES = Path(__file__).parent / "images"
COLOURS = ("#d1242f", "#1a7f37", "#0969da")  # of X, Y and Z
TREE = BodyTree(JOINTS, PARENTS, builtin_rest_joints())
FACING = SPACES["openxr"].rotations_in(np.eye(3))  # the root of a person who stands and looks forward
RIGHTWARD, FORWARD, UP = np.eye(3)  # of that person
WIDTH, HEIGHT, TOP = 380, 400, 66  # pixels of a panel, and above it
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
    """A panel of a sheet with a body, onto which arrows and words can be drawn."""

    def __init__(self, sheet: Sheet, corner: tuple[int, int], joints: np.ndarray, camera: Camera):
        self.sheet, self.corner, self.camera = sheet, corner, camera
        floor = float((joints[:, 2] - np.array(RADII)).min())
        sheet.panel(*corner, camera.width, camera.height).set_data(draw(camera, joints, None, floor))

    def place(self, point: np.ndarray) -> np.ndarray:
        """Return where a point (3,) of the world is on the sheet, pixels from the upper left corner."""
        right, up, _ = self.camera.project(point) * self.camera.scale
        middle = np.array(self.corner) + np.array([self.camera.width, self.camera.height]) / 2
        return middle + np.array([right, -up])

    def arrow(self, start: np.ndarray, end: np.ndarray, colour: str, word: str = "") -> None:
        """Draw an arrow between two points of the world, with a word beyond its head."""
        a, b = self.place(start), self.place(end)
        flipped = [(float(x), self.sheet.height - float(y)) for x, y in (a, b)]
        arrow = FancyArrowPatch(
            *flipped, arrowstyle="-|>", mutation_scale=11, lw=2, shrinkA=0, shrinkB=0, color=colour,
            transform=IdentityTransform(),
        )  # fmt: skip
        self.sheet.figure.add_artist(arrow)
        if word:
            beyond = b + 11 * (b - a) / max(float(np.hypot(*(b - a))), 8.0)
            self.sheet.text(*beyond, word, 16, color=colour, weight="bold")

    def axes(self, origin: np.ndarray, axes: np.ndarray, length: float, words: str = "XYZ") -> None:
        """Draw X, Y and Z, the rows of `axes`, from a point, those farther away first."""
        depth = [float(self.camera.project(origin + axis)[2]) for axis in axes]
        for axis in np.argsort(depth):
            self.arrow(origin, origin + length * axes[axis], COLOURS[axis], words[axis : axis + 1])


def standing(local: np.ndarray | None = None) -> np.ndarray:
    """Return the joints (22, 3) of a person who looks forward, in T-pose or with local rotations."""
    turns = np.tile(np.eye(3), (len(JOINTS), 1, 1)) if local is None else local.copy()
    turns[0] = FACING @ turns[0]
    joints = TREE.positions(turns)
    return joints - [0, 0, (joints[:, 2] - np.array(RADII)).min()]


def camera_on(joints: np.ndarray, azimuth: float = AZIMUTH, scale: float = 155, **size: int) -> Camera:
    """Return a camera on the middle of a body."""
    centre = (joints.min(0) + joints.max(0)) / 2
    size = {"width": WIDTH, "height": HEIGHT} | size
    return Camera(centre, azimuth, size["width"], size["height"], scale, np.deg2rad(14))


def engines(sheet: Sheet) -> None:
    """Draw a person and the axes of each convention."""
    joints = standing()
    for index, engine in enumerate(ENGINES):
        row, column = divmod(index, 3)
        x, y = column * WIDTH, row * (TOP + HEIGHT)
        hand = "right-handed" if engine.right_handed else "left-handed"
        sheet.text(x + WIDTH / 2, y + 24, engine.name, 19, weight="bold")
        sheet.text(x + WIDTH / 2, y + 50, f"{hand}, {engine.words}", 14, color=FAINT)
        view = View(sheet, (x, y + TOP), joints, camera_on(joints))
        view.axes(joints[0] * [1, 1, 0] + 0.75 * FORWARD, np.array(engine.axes), 0.42)


def identities(sheet: Sheet) -> None:
    """Draw the body all of whose rotations are the identity, in each space."""
    for column, space in enumerate(SPACES.values()):
        joints = TREE.positions(rooted(space, np.eye(3)))
        joints = joints - [0, 0, (joints[:, 2] - np.array(RADII)).min()]
        sheet.text((column + 0.5) * WIDTH, 24, space.name, 19, weight="bold")
        sheet.text((column + 0.5) * WIDTH, 50, LIES[space.name], 14, color=FAINT)
        view = View(sheet, (column * WIDTH, TOP), joints, camera_on(joints, scale=150))
        corner = joints[0] * [1, 1, 0] + np.array([0.75, 0.75, 0.0])
        view.axes(corner, space.world.T, 0.4)


LIES = {
    "amass": "lies on the back: Y is up in SMPL's body",
    "openxr": "stands, looks along -Z",
    "unity": "stands, looks along +Z",
}


def rooted(space: Space, root: np.ndarray) -> np.ndarray:
    """Return local rotations (22, 3, 3) as of AMASS, the root's from a space, the others the identity."""
    turns = np.tile(np.eye(3), (len(JOINTS), 1, 1))
    return space.pose_in(np.concatenate([root[None], turns[1:]]))


def trackers(sheet: Sheet) -> None:
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
    for column, (local, title) in enumerate(zip((still, posed), words, strict=True)):
        joints = standing(local)
        left = column * 570
        sheet.text(left + 285, 30, title, 18, weight="bold")
        view = View(sheet, (left, 50), joints, camera_on(joints, scale=228, width=570, height=530))
        turns = global_turns(local)
        for joint in TRACKED:
            view.axes(joints[joint], SPACES["openxr"].world.T @ turns[joint].T, 0.26)


def global_turns(local: np.ndarray) -> np.ndarray:
    """Return each joint's turn from the T-pose (22, 3, 3) of a standing person, in AMASS' world."""
    turns = local.copy()
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            turns[joint] = turns[parent] @ local[joint]
    return FACING @ turns @ FACING.T


def t_pose(sheet: Sheet) -> None:
    """Draw the T-pose from the front with the joints' indices, and list their names."""
    joints = standing()
    view = View(sheet, (190, 20), joints, camera_on(joints, np.pi, 330, width=760, height=640))
    for joint, point in enumerate(joints):
        x, y = view.place(point)
        if joint in TRACKED:
            sheet.text(x, y, "○", 34, color=INK, weight="bold")
        sheet.text(x, y, "●", 12, color=colour(joint))
        beside = {"ha": "left"} if colour(joint) == MIDDLE else {}
        shift = np.array([12, 0]) if beside else np.array([0, -19])
        sheet.text(*(np.array([x, y]) + shift), str(joint), 15, weight="bold", **beside)
    for left, shown in ((20, RIGHT), (1000, LEFT), (1000, MIDDLE)):
        listed = [joint for joint in range(len(JOINTS)) if colour(joint) == shown]
        for row, joint in enumerate(listed):
            top = 480 if shown == MIDDLE else 60
            sheet.text(left, top + 26 * row, f"{joint}  {JOINTS[joint]}", 16, ha="left", color=shown)
    sheet.text(
        570, 674, "from the front: the person's left is on the right; ○ has a tracker", 15, color=FAINT
    )


def colour(joint: int) -> str:
    """Return the colour of a joint's side."""
    return {"left": LEFT, "right": RIGHT}.get(JOINTS[joint].split("_")[0], MIDDLE)


PICTURES = {
    "engine_axes": (engines, 3 * WIDTH, 2 * (TOP + HEIGHT)),
    "engine_identity": (identities, 3 * WIDTH, TOP + HEIGHT),
    "engine_trackers": (trackers, 1140, 580),
    "engine_joints": (t_pose, 1160, 694),
}


def main() -> None:
    """Write all pictures."""
    for name, (picture, width, height) in PICTURES.items():
        sheet = Sheet(width, height)
        picture(sheet)
        atomic_write(IMAGES / f"{name}.png", png(sheet.pixels()))


if __name__ == "__main__":
    main()
