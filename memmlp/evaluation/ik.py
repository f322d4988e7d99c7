"""Inverse kinematics: finds local rotations that match the position branch (App. A) or the trackers.

The paper runs at most 15 iterations of L-BFGS from the rotation branch's pose (Table 6; docs/readings.md,
no. 11).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.functional import jacobian

from memmlp.motion.body import HEAD, N_JOINTS, PARENTS, POSITION, ROTATION, SPARSE_POSITION
from memmlp.motion.geometry import (
    axis_angle_to_matrix,
    forward_kinematics,
    matrix_to_sixd,
    sixd_to_matrix,
)
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.limb_solver import bend_arms_to_trackers, use_tracker_rotations

CPU_CHUNK = 1024  # frames

Objective = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Maps variables (n, D) and their rows (n,) to values (n,) and gradients (n, D)."""


class NoIK:
    """No inverse kinematics: only the two branches are evaluated."""

    def solutions(self, normalizer: Normalizer, motion: Tensor, sparse: Tensor) -> dict[str, Tensor]:
        """Return an empty dict."""
        return {}


@dataclass(frozen=True)
class LBFGS:
    """L-BFGS on each frame separately: Table 6's "Rotation + Position Branch".

    The variables are an axis-angle increment per joint. It multiplies the predicted rotation from the right.
    Unlike 6D, it does not have a redundant scale. The head stays on its tracker, like in
    `Normalizer.compute_positions`, so the objective is the distance that the metrics measure. Rotations of
    leaf joints move no joint and keep their predicted values. All computations use float64, so the result of
    a frame does not depend on the other frames.

    torch.optim.LBFGS is not used. It has one step length and one curvature for a whole batch, so the result
    of a frame would depend on the other frames.

    Attributes:
        iterations: maximum number of iterations.
        chunk: maximum number of frames that are solved together; on a CPU, fewer are faster.
    """

    iterations: int = 15
    chunk: int = 4096

    def solutions(self, normalizer: Normalizer, motion: Tensor, sparse: Tensor) -> dict[str, Tensor]:
        """Return {"combined": motion}: the motion (N, 198) with the best-fitting rotations.

        Args:
            normalizer: provides the rest pose.
            motion: predicted motion (N, 198), world.
            sparse: inputs (N, 54), world.
        """
        chunk = self.chunk if motion.is_cuda else min(self.chunk, CPU_CHUNK)
        parts = zip(motion.split(chunk), sparse.split(chunk), strict=True)
        rotations = torch.cat([self.solve(normalizer, *part) for part in parts])
        return {"combined": torch.cat([rotations, motion[:, POSITION]], -1)}

    def solve(self, normalizer: Normalizer, motion: Tensor, sparse: Tensor) -> Tensor:
        """Return 6D rotations (N, 132) that minimise the distance to the joints of the position branch.

        A frame with NaN or infinite joints gets NaN rotations.
        """
        start = sixd_to_matrix(motion[:, ROTATION].double().unflatten(-1, (N_JOINTS, 6)))
        head = sparse[:, SPARSE_POSITION][:, :3].double()
        target = motion[:, POSITION].double().unflatten(-1, (N_JOINTS, 3)) - head[:, None]
        distance = JointDistance(start, target, normalizer.rest.double())
        increment = minimise(distance, torch.zeros_like(start[..., 0]).flatten(1), self.iterations)
        solved = matrix_to_sixd(distance.apply_increment(increment)).flatten(1).to(motion.dtype)
        return torch.where(target.flatten(1).isfinite().all(1, keepdim=True), solved, torch.nan)


class Arms:
    """Moves the wrists to their trackers in closed form (`memmlp.networks.limb_solver`).

    Only the arms change. Predicted positions are not needed, so it works with every network.
    """

    def solutions(self, normalizer: Normalizer, motion: Tensor, sparse: Tensor) -> dict[str, Tensor]:
        """Return {"combined": motion}: the motion (N, 198) with arms that reach the trackers.

        Args:
            normalizer: provides the rest pose.
            motion: predicted motion (N, 198), world.
            sparse: inputs (N, 54), world.
        """
        local = sixd_to_matrix(motion[:, ROTATION].unflatten(-1, (N_JOINTS, 6)))
        rotations, _ = forward_kinematics(local, torch.zeros_like(sparse[:, :3]), normalizer.rest)
        turned = use_tracker_rotations(matrix_to_sixd(rotations).flatten(1), sparse)
        solved = normalizer.build_world_motion(turned, sparse, bend_arms_to_trackers)
        return {"combined": torch.cat([solved[:, ROTATION], motion[:, POSITION]], -1)}


IK = NoIK | LBFGS | Arms


LEVER = 0.1  # m^2; limits the units of joints that move other joints little


class JointDistance:
    """The objective: the sum of squared distances (m^2) between joints and targets.

    Joints and targets are relative to the head.

    Args:
        start: local rotations (N, 22, 3, 3).
        target: target positions (N, 22, 3) relative to the head, metres.
        rest: rest positions (22, 3), metres.
    """

    def __init__(self, start: Tensor, target: Tensor, rest: Tensor):
        self.start, self.target, self.rest = start, target, rest
        self.unit = _compute_units(tuple(rest.flatten().tolist()), rest.dtype, rest.device)
        self.below = _find_joints_below().to(rest)

    def __call__(self, increment: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return the objective (n,) and its gradient (n, 66) at increments (n, 66) for the frames `rows`
        (n,). A small turn of a joint moves the joints below it, so its gradient is their torque about it."""
        turn = self.scale_increment(increment)
        rotations, positions = _pose(self.start[rows], turn, self.rest)
        error = positions - positions[:, HEAD : HEAD + 1] - self.target[rows]
        force = 2 * error
        force[:, HEAD] -= force.sum(1)
        moment = torch.linalg.cross(positions, force)
        force, moment = (self.below @ torch.cat([force, moment], -1)).split(3, -1)
        torque = moment - torch.linalg.cross(positions, force)
        local = (torque[..., None, :] @ rotations)[..., 0, :]
        gradient = _transpose_right_jacobian(turn, local) * self.unit
        return error.square().sum((1, 2)), gradient.flatten(1)

    def apply_increment(self, increment: Tensor) -> Tensor:
        """Return the local rotations (N, 22, 3, 3) after increments (N, 66)."""
        return self.start @ axis_angle_to_matrix(self.scale_increment(increment))

    def scale_increment(self, increment: Tensor) -> Tensor:
        """Convert increments (n, 66) to axis-angle (n, 22, 3), radians."""
        return increment.unflatten(-1, (N_JOINTS, 3)) * self.unit


def _pose(start: Tensor, turn: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
    """Return global rotations (n, 22, 3, 3) and joint positions (n, 22, 3) relative to the root, metres. The
    axis-angle increments `turn` (n, 22, 3) multiply the local rotations `start` from the right."""
    return forward_kinematics(start @ axis_angle_to_matrix(turn), torch.zeros_like(turn[:, 0]), rest)


@lru_cache(maxsize=1)
def _find_joints_below() -> Tensor:
    """Return (22, 22): 1 where a column's joint is the row's joint or moves with it."""
    below = torch.eye(N_JOINTS)
    for joint in reversed(range(1, N_JOINTS)):
        below[PARENTS[joint]] += below[joint]
    return below


def _transpose_right_jacobian(turn: Tensor, vector: Tensor) -> Tensor:
    """Return J^T v (..., 3), where exp(turn + d) = exp(turn) exp(J d) for small d (Chirikjian 2011)."""
    square = turn.square().sum(-1, keepdim=True)
    small = square < 1e-4
    safe = torch.where(small, 1, square)
    angle = safe.sqrt()
    first = torch.where(small, 0.5 - square / 24, (1 - angle.cos()) / safe)
    second = torch.where(small, 1 / 6 - square / 120, (angle - angle.sin()) / (safe * angle))
    once = torch.linalg.cross(turn, vector)
    return vector + first * once + second * torch.linalg.cross(turn, once)


@lru_cache(maxsize=8)
def _compute_units(rest: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the unit of rotation (22, 1) per joint for a rest pose of 66 coordinates.

    A hip rotation moves more joints than a wrist rotation. With these units, the objective has about the same
    curvature for each variable. So few iterations are enough, and neighbouring frames get similar solutions.
    """
    still = torch.eye(3, dtype=dtype, device=device).expand(1, N_JOINTS, 3, 3)
    pose = torch.tensor(rest, dtype=dtype, device=device).unflatten(0, (N_JOINTS, 3))

    def place(turn: Tensor) -> Tensor:
        _, positions = _pose(still, turn[None], pose)
        return (positions - positions[:, HEAD : HEAD + 1]).flatten()

    moved = jacobian(place, torch.zeros_like(pose))
    return (2 * moved.square().sum(0).mean(-1, keepdim=True) + LEVER).rsqrt()


class Curvature(NamedTuple):
    """The changes in one step; L-BFGS estimates the curvature from them.

    Attributes:
        x: change of the variables (N, D).
        gradient: change of the gradient (N, D).
        inverse: 1 / (inner product of x and gradient) (N,); 0 for rows that are not used.
    """

    x: Tensor
    gradient: Tensor
    inverse: Tensor


ARMIJO = 1e-4  # the fraction of the linearly predicted decrease that a step must reach
HALVINGS = 10  # number of step lengths to try; each is half of the previous one
CURVATURE = 1e-12  # rows with a smaller x @ gradient / gradient**2 (see Curvature) are not used


@torch.no_grad()
def minimise(objective: Objective, x: Tensor, iterations: int, history: int = 10) -> Tensor:
    """Run L-BFGS (Nocedal and Wright, Algorithm 7.4) on each row of x (N, D) separately.

    Each row has its own curvature and step length. The step length starts at 1 and is halved until Armijo's
    condition holds. If no step satisfies it, the row stays unchanged. So the objective never rises.

    Returns:
        The final variables (N, D).
    """
    value, gradient = objective(x, torch.arange(len(x), device=x.device))
    steps: list[Curvature] = []
    for _ in range(iterations):
        direction = -apply_inverse_hessian(gradient, steps)
        after, value, new_gradient = search_step_length(objective, x, value, gradient, direction)
        steps = [*steps, compute_curvature(after - x, new_gradient - gradient)][-history:]
        x, gradient = after, new_gradient
    return x


def compute_curvature(x: Tensor, gradient: Tensor) -> Curvature:
    """Return the curvature of a step from its changes (N, D).

    Rows without positive curvature are not used.
    """
    product = (x * gradient).sum(-1)
    useful = product > CURVATURE * gradient.square().sum(-1)
    return Curvature(x, gradient, torch.where(useful, 1 / torch.where(useful, product, 1), 0))


def apply_inverse_hessian(gradient: Tensor, steps: list[Curvature]) -> Tensor:
    """Return the estimated inverse Hessian times the gradient (N, D), by the two-loop recursion."""
    q, weights = gradient, []
    for step in reversed(steps):
        weight = step.inverse * (step.x * q).sum(-1)
        q = q - weight[:, None] * step.gradient
        weights.append(weight)
    q = q * estimate_initial_scale(gradient, steps)[:, None]
    for step, weight in zip(steps, reversed(weights), strict=True):
        q = q + (weight - step.inverse * (step.gradient * q).sum(-1))[:, None] * step.x
    return q


def estimate_initial_scale(gradient: Tensor, steps: list[Curvature]) -> Tensor:
    """Return the scale (N,) of each row's initial inverse Hessian, which is a scaled identity.

    The newest usable step of the row determines the scale. If a row has no usable step, the scale limits the
    length of the first step to 1.
    """
    length = 1 / gradient.norm(dim=-1).clamp_min(1)
    for step in steps:
        square = step.gradient.square().sum(-1)
        useful = step.inverse > 0
        length = torch.where(useful, 1 / torch.where(useful, step.inverse * square, 1), length)
    return length


def search_step_length(
    objective: Objective, x: Tensor, value: Tensor, gradient: Tensor, direction: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Halve each row's step until it satisfies Armijo's condition.

    Returns:
        Variables (N, D), values (N,) and gradients (N, D) after the step. A row stays unchanged if no step
        satisfies the condition.
    """
    slope = (gradient * direction).sum(-1)
    rows = (slope < 0).nonzero()[:, 0]
    x, value, gradient, length = x.clone(), value.clone(), gradient.clone(), 1.0
    for _ in range(HALVINGS):
        trial = x[rows] + length * direction[rows]
        reached, slopes = objective(trial, rows)
        good = reached <= value[rows] + ARMIJO * length * slope[rows]
        found = rows[good]
        x[found], value[found], gradient[found] = trial[good], reached[good], slopes[good]
        rows, length = rows[~good], length / 2
        if not len(rows):
            break
    return x, value, gradient
