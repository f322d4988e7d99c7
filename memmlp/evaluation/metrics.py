"""The standard metrics as pure functions of one clip; lower values are better.

Positions (N, 22, 3) are metres in the world at 60 Hz; rotations (N, 22, 3, 3) are local, except that
the root rotation is global.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from memmlp.common.errors import InputError
from memmlp.evaluation.metric_facts import MetricSet
from memmlp.motion.body import FPS, HANDS, LOWER, ROOT, UPPER
from memmlp.motion.geometry import axis_angle_to_matrix, compute_geodesic_angle, matrix_to_axis_angle

POSITION_GROUPS = {"Hand PE": HANDS, "Upper PE": UPPER, "Lower PE": LOWER, "Root PE": (ROOT,)}


def compute_mpjre(predicted: Tensor, truth: Tensor) -> Tensor:
    """Return AGRoL's MPJRE in degrees: the mean absolute difference of the axis-angle components.

    It compares the 63 components of joints 1-21, and wraps each difference to [-pi, pi]. The result is not an
    angle: a rotation error of 5 degrees gives 2.5 to 3.2.
    """
    return compare_axis_angles(predicted[:, 1:], truth[:, 1:], "wrapped")


def compare_axis_angles(predicted: Tensor, truth: Tensor, angles: str) -> Tensor:
    """Return the mean absolute difference of the axis-angle components in degrees; see `MetricSet.angles`."""
    difference = matrix_to_axis_angle(predicted) - matrix_to_axis_angle(truth)
    if angles == "wrapped":
        difference = torch.remainder(difference + math.pi, 2 * math.pi) - math.pi
    elif angles == "turned":
        difference = matrix_to_axis_angle(axis_angle_to_matrix(difference))
    return torch.rad2deg(difference.abs().mean())


def compute_geodesic_error(predicted: Tensor, truth: Tensor) -> Tensor:
    """Return the mean angle between predicted and true local rotations of joints 1-21, in degrees."""
    return torch.rad2deg(compute_geodesic_angle(predicted[:, 1:], truth[:, 1:]).mean())


def compute_position_error(predicted: Tensor, truth: Tensor, joints: tuple[int, ...] | None = None) -> Tensor:
    """Return the mean distance over frames and the given joints (all 22 by default), in centimetres."""
    distance = (predicted - truth).norm(dim=-1)
    return 100 * (distance if joints is None else distance[:, list(joints)]).mean()


def compute_velocity_error(predicted: Tensor, truth: Tensor) -> Tensor:
    """Return the mean velocity error (MPJVE) in cm/s; NaN for fewer than 2 frames.

    A velocity is the difference between consecutive frames.
    """
    return 100 * FPS * (predicted.diff(dim=0) - truth.diff(dim=0)).norm(dim=-1).mean()


def compute_jitter(positions: Tensor) -> Tensor:
    """Return the mean jerk (third difference of positions) in 10^2 m/s^3; NaN for fewer than 4 frames."""
    return positions.diff(n=3, dim=0).norm(dim=-1).mean() * FPS**3 / 100


def measure_positions(predicted: Tensor, truth: Tensor) -> dict[str, float]:
    """Return the position metrics of one clip as a dict from metric name to value."""
    report = {
        "MPJPE": compute_position_error(predicted, truth),
        **{name: compute_position_error(predicted, truth, group) for name, group in POSITION_GROUPS.items()},
        "MPJVE": compute_velocity_error(predicted, truth),
        "Jitter": compute_jitter(predicted),
        "GT Jitter": compute_jitter(truth),
    }
    return {name: float(value) for name, value in report.items()}


def measure_rotations(predicted: Tensor, truth: Tensor) -> dict[str, float]:
    """Return the rotation metrics of one clip as a dict from metric name to value."""
    return {
        "MPJRE": float(compute_mpjre(predicted, truth)),
        "geodesic": float(compute_geodesic_error(predicted, truth)),
    }


def measure_as_released(
    chosen: MetricSet, rotations: tuple[Tensor, Tensor], positions: tuple[Tensor, Tensor]
) -> dict[str, float]:
    """Return the metrics of one clip as a repository's released test computes them.

    Args:
        chosen: the released test.
        rotations: predicted and true rotations (N, 22, 3, 3).
        positions: predicted and true positions (N, 22, 3).

    Returns:
        The metrics by name; empty for a clip that the test leaves out.
    """
    frames = len(positions[0])
    if frames < chosen.least:
        return {}
    kept = slice(chosen.first, frames - (frames - chosen.least) % chosen.hop)
    predicted, truth = (one[kept] for one in positions)
    turned, true_turned = (one[kept, (0 if chosen.root else 1) :] for one in rotations)
    report = measure_positions(predicted, truth)
    report["MPJRE"] = float(compare_axis_angles(turned, true_turned, chosen.angles))
    for name, group in (("Upper PE", UPPER), ("Lower PE", LOWER)):
        joints = {*group} - {ROOT} | ({ROOT} if chosen.root_in == name else set())
        report[name] = float(compute_position_error(predicted, truth, tuple(joints)))
    return {name: report[name] for name in chosen.metrics}


@dataclass(frozen=True)
class UserMetric:
    """A custom metric.

    Attributes:
        function: gets the prediction and the truth of one clip, and returns one number.
        of: the input of the function: "positions" (N, 22, 3) or "rotations" (N, 22, 3, 3).
    """

    function: Callable[[Tensor, Tensor], Tensor]
    of: str


UserMetrics = Mapping[str, UserMetric]


def compute_custom_metrics(
    custom: UserMetrics, of: str, predicted: Tensor, truth: Tensor
) -> dict[str, float]:
    """Return one clip's values of the custom metrics by name.

    Args:
        custom: the custom metrics by name.
        of: "positions" or "rotations"; metrics with another input are skipped.
        predicted: the predicted positions or rotations.
        truth: the true positions or rotations.

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
                raise InputError(f"metric {name}: must return a number ({error})") from error
    return report
