"""The user of the trackers: body height, floor and device offsets, and the calibration file with them.

A network is trained on bodies of one size, with the floor at height zero. So input positions are scaled about
the floor by the network's body height divided by the user's. Output positions are scaled back. Angles stay
the same."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from memmlp.common.errors import InputError, describe_read_error
from memmlp.common.files import write_json
from memmlp.live.rotations import BodyTree
from memmlp.live.spaces import SpaceName, find_space

STATURE = 1.72 / 1.57
"""The built-in adult's body height, divided by the height of the head joint above the lowest joint."""

HEIGHTS = (0.5, 2.5)  # metres; from a small child to more than the tallest person
DEEPEST = 100.0  # maximum distance of the floor from height zero, metres
TILTED = np.radians(60)  # from upright; the heading of a device with more tilt is undefined
ORTHONORMAL = 1e-2  # how far a matrix may be from orthonormal
LARGEST = 100_000  # maximum number of bytes of a calibration file
SAME = 5e-3  # metres; joints of equal bodies may differ by this distance
MADE = "expected a file from memmlp live --calibration"


@dataclass(frozen=True)
class Wearer:
    """The user of the trackers: body height and height of the floor in the trackers' frame of reference, both
    in metres, and the network's body height divided by the user's."""

    height: float
    floor: float
    scale: float

    def scale_to_network(self, positions: np.ndarray) -> np.ndarray:
        """Scale the user's positions (..., 3), metres, AMASS' axes, to the network's body size and floor."""
        return (positions - np.array([0.0, 0.0, self.floor])) * self.scale


def compute_body_height(body: BodyTree) -> float:
    """Return the height, metres, of a person with the rest pose of a body."""
    heights = body.rest[:, 1]
    return STATURE * float(heights[body.tracked[0]] - heights.min())


def make_wearer(body: BodyTree, height: float | None = None, floor: float = 0.0) -> Wearer:
    """Return the user of a network's body; height (None for the body's) and floor in metres. Raises
    InputError if height or floor is out of range."""
    low, high = HEIGHTS
    if height is not None and not (_is_number(height) and low <= height <= high):
        raise InputError(f"height={height}: must be {low:g} to {high:g} metres, or None")
    if not (_is_number(floor) and abs(floor) <= DEEPEST):
        raise InputError(f"floor={floor}: must be {-DEEPEST:g} to {DEEPEST:g} metres")
    network_height = compute_body_height(body)
    return Wearer(float(height or network_height), float(floor), network_height / height if height else 1.0)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and math.isfinite(value)


class Offsets(NamedTuple):
    """The poses of head, left and right wrist relative to their devices: joint = device @ offset. Positions
    (3, 3), metres, and rotations (3, 3, 3) are in each device's own axes."""

    positions: np.ndarray
    rotations: np.ndarray

    @property
    def distances(self) -> np.ndarray:
        """The distance of each device from its joint (3,), metres."""
        return np.linalg.norm(self.positions, axis=1)

    @property
    def tilt_warning(self) -> str | None:
        """A warning if the head's device is far from upright; otherwise None."""
        tilt = float(np.arccos(np.clip(self.rotations[0, 1, 1], -1, 1)))  # Y is up in every space's body axes
        if tilt <= TILTED:
            return None
        wrong = f"the head's device is {np.degrees(tilt):.0f} degrees from upright"
        return f"{wrong}; check that quaternions are xyzw, and check `space`"


def check_offsets(offsets: Offsets) -> Offsets:
    """Return the offsets as float64 arrays. Raises InputError if they are malformed."""
    expected = "must be positions (3, 3) and rotations (3, 3, 3) in a memmlp.Offsets"
    try:
        positions, rotations = (np.asarray(part, np.float64) for part in offsets)
    except (TypeError, ValueError):
        raise InputError(f"offsets: {expected}") from None
    if positions.shape != (3, 3) or rotations.shape != (3, 3, 3):
        raise InputError(f"offsets: {expected}; the shapes are {positions.shape} and {rotations.shape}")
    if not (np.isfinite(positions).all() and np.isfinite(rotations).all()):
        raise InputError("offsets: must not contain NaN or infinity")
    check_rotations([f"offsets of {name}" for name in ("head", "left", "right")], rotations)
    return Offsets(positions, rotations)


def check_rotations(names: list[str], rotations: np.ndarray) -> None:
    """Raise InputError unless all matrices (3, 3, 3) are rotations."""
    product = rotations @ rotations.swapaxes(1, 2)
    if np.abs(product - np.eye(3)).max() <= ORTHONORMAL and np.linalg.det(rotations).min() > 0:
        return
    for name, matrix in zip(names, rotations, strict=True):
        if np.abs(matrix @ matrix.T - np.eye(3)).max() > ORTHONORMAL:
            raise InputError(f"{name}: must be a rotation matrix (3, 3); this matrix is not orthonormal")
        if np.linalg.det(matrix) < 0:
            raise InputError(f"{name}: must be a rotation matrix (3, 3); this matrix mirrors")


@dataclass(frozen=True)
class Calibration:
    """The calibration of a stream for a user. The fields are arguments of `Stream`."""

    space: SpaceName
    offsets: Offsets | None = None
    height: float | None = None
    floor: float = 0.0


def save_calibration(path: Path, calibration: Calibration, body: BodyTree) -> None:
    """Write a calibration for a network's body, atomically. Raises InputError on failure."""
    offsets = calibration.offsets
    fields = {
        "memmlp": "calibration",
        "space": calibration.space,
        "joints": _compute_tracked_joints(body).tolist(),
        "height": calibration.height,
        "floor": calibration.floor,
        "offsets": offsets and {name: part.tolist() for name, part in offsets._asdict().items()},
    }
    try:
        write_json(path, fields)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from error


def read_calibration(path: Path, space: SpaceName, body: BodyTree) -> Calibration:
    """Read the calibration for a frame of reference and a network's body. Raises InputError if the file is
    not a calibration, or is for another frame of reference or body. Height and floor are not checked here."""
    try:
        with open(path, "rb") as file:
            fields = json.loads(file.read(LARGEST))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not a calibration file ({describe_read_error(error)}); {MADE}") from None
    if not isinstance(fields, dict) or fields.get("memmlp") != "calibration":
        raise InputError(f"{path}: is not a calibration file; {MADE}")
    if fields.get("space") != find_space(space).name:
        raise InputError(f"{path}: was made with --space {fields.get('space')}; must be {space}")
    try:
        offsets = fields["offsets"]
        if offsets is not None:
            offsets = check_offsets(Offsets(offsets["positions"], offsets["rotations"]))
        recorded = np.reshape(fields["joints"], (3, 3))
        away = np.linalg.norm(recorded - _compute_tracked_joints(body), axis=1).max()
        if not away <= SAME:
            raise InputError(f"it is for another body, where head or wrists are {100 * away:.1f} cm away")
        return Calibration(space, offsets, fields["height"], fields["floor"])
    except (KeyError, TypeError, ValueError, InputError) as error:
        raise InputError(f"{path}: cannot be used ({error}); {MADE}") from None


def _compute_tracked_joints(body: BodyTree) -> np.ndarray:
    """Return the rest positions (3, 3) of head and wrists, metres, relative to the lowest joint's height. The
    offsets of a calibration are only valid for a body with these positions."""
    joints = body.rest[body.tracked]
    across, _, ahead = joints.mean(0)
    return joints - [across, body.rest[:, 1].min(), ahead]
