"""A piece of a clip with predictions, and the camera that films it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from memmlp.common.errors import InputError
from memmlp.motion.body import FPS, ROOT
from memmlp.motion.limb_shapes import LIMBS, RADII
from memmlp.report.pictures.drawing import ELEVATION, Camera

BOTTOM = -0.195  # height of a picture's lower edge above the floor, metres
SIDE = np.deg2rad(25)  # the camera's angle from the person's front, radians
LOWEST, HIGHEST = 2.15, 2.9  # smallest and largest height that a picture covers, metres
TIP = max(limb.tip + max(limb.radii) for limb in LIMBS)  # largest reach of a limb beyond its joint, metres
SCALES = (10, 15, 20, 30, 40, 50, 75, 100)  # the possible tops of a colour scale, cm
SMOOTHING = 0.4  # seconds over which the camera's path is smoothed


def frame_range(
    length: int, title: str, begin: float, end: float | None, keys: tuple[str, str] = ("begin", "end")
) -> tuple[int, int]:
    """Return the first frame of a piece of a clip, and the frame after its last.

    Args:
        length: the clip's number of frames.
        title: the clip's name.
        begin, end: beginning and end of the piece, seconds; None for the clip's end.
        keys: the options or arguments that gave begin and end.

    Raises:
        InputError: if there is no frame between begin and end.
    """
    stop = length / FPS if end is None else min(end, length / FPS)
    if not 0 <= begin < stop or round(begin * FPS) == round(stop * FPS):  # NaN is neither
        given = f"{keys[0]} {begin:g}" + ("" if end is None else f" {keys[1]} {end:g}")
        raise InputError(f"{given}: there is no frame between; {title} has {length / FPS:.1f} s")
    return round(begin * FPS), round(stop * FPS)


def colour_scale_top(errors: np.ndarray) -> float:
    """Return the top of a scale for errors in cm: the least of `SCALES` below which 98 % of them are."""
    high = float(np.percentile(errors, 98))
    return float(next((top for top in SCALES if high <= top), SCALES[-1]))


@dataclass(frozen=True)
class ClipPiece:
    """A piece of a clip: the truth, and predictions by their labels.

    Attributes:
        title: the clip's name.
        truth: joint positions (N, 22, 3), metres, world (Z up), at 60 Hz.
        predictions: the same for each label.
        start: the index in the clip of the piece's first frame.
    """

    title: str
    truth: np.ndarray
    predictions: Mapping[str, np.ndarray]
    start: int = 0

    @cached_property
    def errors(self) -> dict[str, np.ndarray]:
        """Each joint's distance (N, 22) from the truth, cm, by label."""
        return {k: 100 * np.linalg.norm(p - self.truth, axis=-1) for k, p in self.predictions.items()}

    @cached_property
    def top(self) -> float:
        """The top of the colour scale, cm, shared by all predictions."""
        return colour_scale_top(np.stack(list(self.errors.values())))

    @cached_property
    def floor(self) -> float:
        """The floor's height, metres: where the truth's lowest joints are."""
        return float(np.percentile(self.truth[..., 2].min(1), 5)) - min(RADII)

    @cached_property
    def metres(self) -> float:
        """The height that a picture covers, metres: larger with hands above the head."""
        joints = np.stack([self.truth, *self.predictions.values()])
        distance = np.linalg.norm(joints[..., :2] - self.truth[:, None, ROOT, :2], axis=-1)
        up = joints[..., 2] - self.floor + np.tan(ELEVATION) * distance  # distant joints are drawn higher
        highest = np.nan_to_num(up, nan=0.0, posinf=0.0).max() + TIP
        return float(np.clip(highest - BOTTOM, LOWEST, HIGHEST))

    def rows(self, frame: int) -> list[tuple[np.ndarray, np.ndarray | None]]:
        """Return joints (22, 3) and their errors (22,) as fractions of the scale's top, for each row.

        The truth is first; its errors are None.
        """
        predicted = [(p[frame], self.errors[k][frame] / self.top) for k, p in self.predictions.items()]
        return [(self.truth[frame], None), *predicted]

    def camera(self, azimuth: float, place: np.ndarray) -> Camera:
        """Return a camera that looks at a person standing at a point (2,) on the floor, metres."""
        return Camera(np.array([*place, self.floor + BOTTOM + self.metres / 2]), azimuth, self.metres)

    def azimuth(self, frame: int) -> float:
        """Return the azimuth, radians, that shows the true person from the front, slightly from the side."""
        left = self.truth[frame, 1] - self.truth[frame, 2]  # from right to left hip
        return float(np.arctan2(left[1], left[0])) + SIDE

    def path(self) -> np.ndarray:
        """Return the camera's position over time (N, 2), metres: the truth's root, smoothed."""
        width = round(SMOOTHING * FPS)
        window = np.hanning(2 * width + 3)[1:-1]
        padded = np.pad(self.truth[:, ROOT, :2], ((width, width), (0, 0)), mode="edge")
        columns = [np.convolve(column, window / window.sum(), "valid") for column in padded.T]
        return np.stack(columns, -1)

    def seconds(self, frame: int) -> float:
        """Return the time of a frame in the clip, seconds."""
        return (self.start + frame) / FPS
