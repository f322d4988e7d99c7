"""The wearer, compared with the network's body: another height, and a floor at another height.

A network knows bodies of one size, that of the rest pose in its file, on a floor at height zero. So positions
are scaled about the floor by the network's height divided by the wearer's on their way in, and scaled back on
their way out. Angles stay the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from memmlp.common.errors import InputError
from memmlp.live.rotations import BodyTree

STATURE = 1.72 / 1.57
"""The built-in adult's body height, divided by the height of the head joint above the lowest joint."""

HEIGHTS = (0.5, 2.5)  # metres; from a small child to more than the tallest person
DEEPEST = 100.0  # metres that a floor may be from the height zero


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
        return (positions - self._up(positions)) * self.scale

    def positions_out(self, positions: np.ndarray) -> np.ndarray:
        """Convert the network's positions (..., 3), metres, AMASS' axes, to the wearer's size and floor."""
        return positions / self.scale + self._up(positions)

    def _up(self, positions: np.ndarray) -> np.ndarray:
        return np.array([0.0, 0.0, self.floor], positions.dtype)


def stature(body: BodyTree) -> float:
    """Return the body height, metres, of a person with this rest pose."""
    heights = body.rest[:, 1]
    return STATURE * float(heights[body.tracked[0]] - heights.min())


def wearer(body: BodyTree, height: float | None = None, floor: float = 0.0) -> Wearer:
    """Return a wearer, given a network's body.

    Args:
        body: the network's body.
        height: the wearer's body height, metres; None for the height of the network's body.
        floor: the height of the floor, metres.

    Raises:
        InputError: if the height is no person's, or the floor is no height.
    """
    low, high = HEIGHTS
    if height is not None and not (_number(height) and low <= height <= high):
        raise InputError(
            f"height={height}: allowed are {low:g} to {high:g} metres, or None for the network's"
        )
    if not (_number(floor) and abs(floor) <= DEEPEST):
        raise InputError(f"floor={floor}: allowed is a height in metres, at most {DEEPEST:g} from zero")
    own = stature(body)
    return Wearer(float(height or own), float(floor), own / height if height else 1.0)


def _number(value: object) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and math.isfinite(value)
