"""The wearer of the trackers: body height, floor and device offsets, and the file that keeps them.

A network knows bodies of one size, that of the rest pose in its file, on a floor at height zero. So positions
are scaled about the floor by the network's height divided by the wearer's on their way in, and scaled back on
their way out. Angles stay the same.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from memmlp.common.errors import InputError, describe_read_error
from memmlp.common.files import write_json
from memmlp.live.rotations import BodyTree
from memmlp.live.spaces import SpaceName, space_of

STATURE = 1.72 / 1.57
"""The built-in adult's body height, divided by the height of the head joint above the lowest joint."""

HEIGHTS = (0.5, 2.5)  # metres; from a small child to more than the tallest person
DEEPEST = 100.0  # metres that a floor may be from the height zero
TILTED = np.radians(60)  # from upright; a device that is tilted further has no heading
ORTHONORMAL = 1e-2  # how far a matrix may be from orthonormal
LARGEST = 100_000  # bytes of a calibration file
SAME = 5e-3  # metres by which two bodies of a height may differ
MADE = "expected a file that memmlp live --calibration wrote"


@dataclass(frozen=True)
class Wearer:
    """The person who wears the trackers.

    Attributes:
        height: the person's body height, metres.
        floor: the height of the floor, metres, in the trackers' frame of reference.
        scale: the network's body height divided by the wearer's.
    """

    height: float
    floor: float
    scale: float

    def positions_in(self, positions: np.ndarray) -> np.ndarray:
        """Convert the wearer's positions (..., 3), metres, AMASS' axes, to the network's size and floor."""
        return (positions - np.array([0.0, 0.0, self.floor])) * self.scale


def stature(body: BodyTree) -> float:
    """Return the body height, metres, of a person with this rest pose."""
    heights = body.rest[:, 1]
    return STATURE * float(heights[body.tracked[0]] - heights.min())


def make_wearer(body: BodyTree, height: float | None = None, floor: float = 0.0) -> Wearer:
    """Return a wearer, given a network's body.

    Args:
        body: the network's body.
        height: the wearer's body height, metres; None for the height of the network's body.
        floor: the height of the floor, metres.

    Raises:
        InputError: if height or floor are out of range.
    """
    low, high = HEIGHTS
    if height is not None and not (_is_number(height) and low <= height <= high):
        raise InputError(f"height={height}: must be {low:g} to {high:g} metres, or None for the network's")
    if not (_is_number(floor) and abs(floor) <= DEEPEST):
        raise InputError(f"floor={floor}: must be a height in metres, at most {DEEPEST:g} from zero")
    own = stature(body)
    return Wearer(float(height or own), float(floor), own / height if height else 1.0)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and math.isfinite(value)


class Offsets(NamedTuple):
    """Where the joints are on the devices: joint = device @ offset, for head, left and right wrist.

    Attributes:
        positions: (3, 3), metres, in each device's own axes.
        rotations: (3, 3, 3), in each device's own axes.
    """

    positions: np.ndarray
    rotations: np.ndarray

    @property
    def distances(self) -> np.ndarray:
        """The distance of each device from its joint (3,), metres."""
        distances: np.ndarray = np.linalg.norm(self.positions, axis=1)
        return distances

    @property
    def doubt(self) -> str | None:
        """A warning about a head's device that is far from upright; None for other devices."""
        tilt = float(np.arccos(np.clip(self.rotations[0, 1, 1], -1, 1)))  # Y is up in every space's body axes
        if tilt <= TILTED:
            return None
        return (
            f"the head's device is {np.degrees(tilt):.0f} degrees from upright; "
            "are quaternions xyzw, and is `space` right?"
        )


def check_offsets(offsets: Offsets) -> Offsets:
    """Return the offsets as float64 arrays. Raises InputError if they are malformed."""
    try:
        positions, rotations = (np.asarray(part, np.float64) for part in offsets)
    except (TypeError, ValueError):
        raise InputError(
            "offsets: expected memmlp.Offsets, positions (3, 3) and rotations (3, 3, 3)"
        ) from None
    if positions.shape != (3, 3) or rotations.shape != (3, 3, 3):
        shapes = f"{positions.shape} and {rotations.shape}"
        raise InputError(f"offsets: shapes {shapes}; expected positions (3, 3) and rotations (3, 3, 3)")
    if not (np.isfinite(positions).all() and np.isfinite(rotations).all()):
        raise InputError("offsets: must not contain NaN or infinity")
    check_rotations([f"offsets of {name}" for name in ("head", "left", "right")], rotations)
    return Offsets(positions, rotations)


def check_rotations(names: list[str], rotations: np.ndarray) -> None:
    """Raise InputError unless matrices (3, 3, 3) are rotations: orthonormal, without mirroring."""
    product = rotations @ rotations.swapaxes(1, 2)
    if np.abs(product - np.eye(3)).max() <= ORTHONORMAL and np.linalg.det(rotations).min() > 0:
        return
    for name, matrix in zip(names, rotations, strict=True):
        if np.abs(matrix @ matrix.T - np.eye(3)).max() > ORTHONORMAL:
            raise InputError(f"{name}: the matrix is not orthonormal; expected a rotation (3, 3)")
        if np.linalg.det(matrix) < 0:
            raise InputError(f"{name}: the matrix is a mirror image; expected a rotation (3, 3)")


@dataclass(frozen=True)
class Calibration:
    """What a stream must know of a wearer; the fields are arguments of `Stream`.

    Attributes:
        space: the frame of reference, in whose axes the offsets are.
        offsets: the offsets of the joints from the devices, or None.
        height: the body height, metres, for which the offsets hold; None for the network's body height.
        floor: the height of the floor, metres.
    """

    space: SpaceName
    offsets: Offsets | None = None
    height: float | None = None
    floor: float = 0.0


def save_calibration(path: Path, calibration: Calibration, body: BodyTree) -> None:
    """Write a calibration for a network's body, atomically. Raises InputError if that fails."""
    offsets = calibration.offsets
    fields = {
        "memmlp": "calibration",
        "space": calibration.space,
        "joints": _tracked_joints(body).tolist(),
        "height": calibration.height,
        "floor": calibration.floor,
        "offsets": offsets and {name: part.tolist() for name, part in offsets._asdict().items()},
    }
    try:
        write_json(path, fields)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from error


def read_calibration(path: Path, space: SpaceName, body: BodyTree) -> Calibration:
    """Read a calibration, for a frame of reference and a network's body.

    Raises:
        InputError: if the file is not a calibration, or is for another frame of reference or for a network
            with another body; the message names the file. Height and floor are checked where they are used.
    """
    try:
        with open(path, "rb") as file:
            fields = json.loads(file.read(LARGEST))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not a calibration ({describe_read_error(error)}); {MADE}") from None
    if not isinstance(fields, dict) or fields.get("memmlp") != "calibration":
        raise InputError(f"{path}: is not a calibration; {MADE}")
    if fields.get("space") != space_of(space).name:
        raise InputError(f"{path}: is for --space {fields.get('space')}, not for {space}")
    try:
        offsets = fields["offsets"]
        if offsets is not None:
            offsets = check_offsets(Offsets(offsets["positions"], offsets["rotations"]))
        away = np.linalg.norm(np.reshape(fields["joints"], (3, 3)) - _tracked_joints(body), axis=1).max()
        if not away <= SAME:
            raise InputError(f"it is for a network's body whose head or wrists are {100 * away:.1f} cm away")
        return Calibration(space, offsets, fields["height"], fields["floor"])
    except (KeyError, TypeError, ValueError, InputError) as error:
        raise InputError(f"{path}: cannot be used ({error}); {MADE}") from None


def _tracked_joints(body: BodyTree) -> np.ndarray:
    """Return the rest positions (3, 3) of head and wrists, metres, above the lowest joint.

    A calibration's offsets hold only for a body with these positions.
    """
    joints = body.rest[body.tracked]
    across, _, ahead = joints.mean(0)
    return joints - [across, body.rest[:, 1].min(), ahead]
