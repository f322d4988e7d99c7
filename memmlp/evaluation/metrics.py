"""The field's metrics as pure functions of one clip; lower is better.

Positions (N, 22, 3) are metres in the world at 60 Hz; rotations (N, 22, 3, 3) are local, except for the
root's, which is global.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from memmlp.common.errors import InputError
from memmlp.motion.body import FPS, HANDS, LOWER, ROOT, UPPER
from memmlp.motion.geometry import geodesic_angle, matrix_to_axis_angle

POSITION_GROUPS = {"Hand PE": HANDS, "Upper PE": UPPER, "Lower PE": LOWER, "Root PE": (ROOT,)}


def mpjre(predicted: Tensor, truth: Tensor) -> Tensor:
    """Return AGRoL's MPJRE in degrees: the mean absolute difference of the axis-angle components.

    The 63 components are those of joints 1-21, and each difference is wrapped to [-pi, pi]. This is not an
    angle: an error of 5 degrees gives a value of 2.5 to 3.2.
    """
    difference = matrix_to_axis_angle(predicted[:, 1:]) - matrix_to_axis_angle(truth[:, 1:])
    wrapped = torch.remainder(difference + math.pi, 2 * math.pi) - math.pi
    return torch.rad2deg(wrapped.abs().mean())


def geodesic(predicted: Tensor, truth: Tensor) -> Tensor:
    """Return the mean angle between predicted and true local rotations of joints 1-21, in degrees."""
    return torch.rad2deg(geodesic_angle(predicted[:, 1:], truth[:, 1:]).mean())


def position_error(predicted: Tensor, truth: Tensor, joints: tuple[int, ...] | None = None) -> Tensor:
    """Return the mean distance over frames and the given joints (all 22 by default), in centimetres."""
    distance = (predicted - truth).norm(dim=-1)
    return 100 * (distance if joints is None else distance[:, list(joints)]).mean()


def velocity_error(predicted: Tensor, truth: Tensor) -> Tensor:
    """Return the mean norm of the difference of velocities between frames (MPJVE), in cm/s.

    It is NaN for fewer than 2 frames.
    """
    return 100 * FPS * (predicted.diff(dim=0) - truth.diff(dim=0)).norm(dim=-1).mean()


def jitter(positions: Tensor) -> Tensor:
    """Return the mean norm of the positions' third difference, in 10^2 m/s^3; NaN for fewer than 4 frames."""
    return positions.diff(n=3, dim=0).norm(dim=-1).mean() * FPS**3 / 100


def positions_report(predicted: Tensor, truth: Tensor) -> dict[str, float]:
    """Return the position metrics of one clip by name."""
    report = {"MPJPE": position_error(predicted, truth)}
    report |= {name: position_error(predicted, truth, group) for name, group in POSITION_GROUPS.items()}
    report |= {
        "MPJVE": velocity_error(predicted, truth),
        "Jitter": jitter(predicted),
        "GT Jitter": jitter(truth),
    }
    return {name: float(value) for name, value in report.items()}


def rotations_report(predicted: Tensor, truth: Tensor) -> dict[str, float]:
    """Return the rotation metrics of one clip by name."""
    return {"MPJRE": float(mpjre(predicted, truth)), "geodesic": float(geodesic(predicted, truth))}


@dataclass(frozen=True)
class UserMetric:
    """A custom metric.

    Attributes:
        function: maps prediction and truth of one clip to one number.
        of: what the function gets: "positions" (N, 22, 3) or "rotations" (N, 22, 3, 3).
    """

    function: Callable[[Tensor, Tensor], Tensor]
    of: str


UserMetrics = Mapping[str, UserMetric]


def custom_report(custom: UserMetrics, of: str, predicted: Tensor, truth: Tensor) -> dict[str, float]:
    """Return one clip's values of the custom metrics that take positions, or of those that take rotations.

    Raises:
        InputError: if a metric does not return a number; the message names the metric.
    """
    report = {}
    for name, metric in custom.items():
        if metric.of == of:
            value = metric.function(predicted, truth)
            try:
                report[name] = float(value)
            except (TypeError, ValueError, RuntimeError) as error:
                raise InputError(f"metric {name}: must return a number: {error}") from error
    return report
