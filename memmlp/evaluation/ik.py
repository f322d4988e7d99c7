"""The inverse-kinematics slot: finds local rotations that match the position branch (App. A) or the trackers.

The paper runs L-BFGS for at most 15 iterations from the rotation branch's pose (Table 6, reading 11).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.functional import jacobian

from memmlp.motion.body import HEAD, N_JOINTS, POSITION, ROTATION, SPARSE_POSITION
from memmlp.motion.geometry import (
    axis_angle_to_matrix,
    forward_kinematics,
    matrix_to_sixd,
    sixd_to_matrix,
)
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.limb_solver import reach_hands, use_tracker_rotations

Objective = Callable[[Tensor, Tensor], Tensor]


class NoIK:
    """No inverse kinematics: there is no third result beside the two branches."""

    def solutions(self, normalizer: Normalizer, motion: Tensor, sparse: Tensor) -> dict[str, Tensor]:
        """Return an empty dict."""
        return {}


@dataclass(frozen=True)
class LBFGS:
    """L-BFGS on each frame separately: Table 6's "Rotation + Position Branch".

    The variables are an axis-angle increment for each joint, applied on the right of its predicted rotation:
    the increment is smooth around the start, and lacks the redundant scale of 6D. The head stays on its
    tracker as in `Normalizer.pose`, so that the minimised distance is the measured one. A rotation that moves
    no joint (at the leaves) stays as predicted. Everything is computed in float64, so that a frame's result
    does not depend on its neighbours.

    torch.optim.LBFGS is not used, since over a batch it has one step length and one curvature for all frames,
    so that a frame's result depends on the other frames of the batch.

    Attributes:
        iterations: largest number of iterations.
        chunk: number of frames that are solved together.
    """

    iterations: int = 15
    chunk: int = 4096

    def solutions(self, normalizer: Normalizer, motion: Tensor, sparse: Tensor) -> dict[str, Tensor]:
        """Return the motion (N, 198) with the best-fitting rotations, under the name "combined".

        Args:
            normalizer: converts between the world and network space; its rest pose is used.
            motion: predicted motion (N, 198), world.
            sparse: inputs (N, 54), world.
        """
        parts = zip(motion.split(self.chunk), sparse.split(self.chunk), strict=True)
        rotations = torch.cat([self.solve(normalizer, *part) for part in parts])
        return {"combined": torch.cat([rotations, motion[:, POSITION]], -1)}

    def solve(self, normalizer: Normalizer, motion: Tensor, sparse: Tensor) -> Tensor:
        """Return rotations (N, 132) in 6D that bring each frame's joints nearest to the position branch's.

        A frame with NaN or infinite joints gets NaN rotations.
        """
        start = sixd_to_matrix(motion[:, ROTATION].double().unflatten(-1, (N_JOINTS, 6)))
        head = sparse[:, SPARSE_POSITION][:, :3].double()
        target = motion[:, POSITION].double().unflatten(-1, (N_JOINTS, 3)) - head[:, None]
        distance = JointDistance(start, target, normalizer.rest.double())
        increment = minimise(distance, torch.zeros_like(start[..., 0]).flatten(1), self.iterations)
        solved = matrix_to_sixd(distance.turned(increment)).flatten(1).to(motion.dtype)
        return torch.where(target.flatten(1).isfinite().all(1, keepdim=True), solved, torch.nan)


class Arms:
    """The arms alone, in closed form: wrists are brought to their trackers (`memmlp.networks.limb_solver`).

    It needs no predicted positions, so it works with every network.
    """

    def solutions(self, normalizer: Normalizer, motion: Tensor, sparse: Tensor) -> dict[str, Tensor]:
        """Return the motion (N, 198) with arms that reach the trackers, under the name "combined".

        Args:
            normalizer: its rest pose is used.
            motion: predicted motion (N, 198), world.
            sparse: inputs (N, 54), world.
        """
        local = sixd_to_matrix(motion[:, ROTATION].unflatten(-1, (N_JOINTS, 6)))
        rotations, _ = forward_kinematics(local, torch.zeros_like(sparse[:, :3]), normalizer.rest)
        turned = use_tracker_rotations(matrix_to_sixd(rotations).flatten(1), sparse)
        solved = normalizer.posed_in_world(turned, sparse, reach_hands)
        return {"combined": torch.cat([solved[:, ROTATION], motion[:, POSITION]], -1)}


IK = NoIK | LBFGS | Arms


LEVER = 0.1  # m^2, bounds the unit of a joint whose turn moves little


class JointDistance:
    """The objective: the sum over joints of the squared distance (m^2) to targets relative to the head.

    Args:
        start: local rotations (N, 22, 3, 3).
        target: positions (N, 22, 3) relative to the head, metres.
        rest: rest positions (22, 3), metres.
    """

    def __init__(self, start: Tensor, target: Tensor, rest: Tensor):
        self.start, self.target, self.rest = start, target, rest
        self.unit = _units(tuple(rest.flatten().tolist()), rest.dtype, rest.device)

    def __call__(self, increment: Tensor, rows: Tensor) -> Tensor:
        """Return the objective (n,) at increments (n, 66) of the rows (n,) of `start` and `target`."""
        joints = _joints(self.start[rows], self.turn(increment), self.rest)
        return (joints - self.target[rows]).square().sum((1, 2))

    def turned(self, increment: Tensor) -> Tensor:
        """Return the local rotations (N, 22, 3, 3) after increments (N, 66)."""
        return self.start @ axis_angle_to_matrix(self.turn(increment))

    def turn(self, increment: Tensor) -> Tensor:
        """Convert increments (n, 66) to axis-angle (n, 22, 3), radians."""
        return increment.unflatten(-1, (N_JOINTS, 3)) * self.unit


def _joints(start: Tensor, turn: Tensor, rest: Tensor) -> Tensor:
    """Return the joints' positions (n, 22, 3) relative to the head, metres.

    Args:
        start: local rotations (n, 22, 3, 3).
        turn: axis-angle increments (n, 22, 3), applied on their right.
        rest: rest positions (22, 3), metres.
    """
    local = start @ axis_angle_to_matrix(turn)
    _, positions = forward_kinematics(local, torch.zeros_like(local[:, 0, 0]), rest)
    return positions - positions[:, HEAD : HEAD + 1]


@lru_cache(maxsize=8)
def _units(rest: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return each joint's unit of rotation (22, 1) for 66 coordinates of a rest pose; cached per rest pose.

    Turning a hip moves more joints than turning a wrist. With these units, the objective's curvature is about
    the same for each variable, so that few iterations suffice and neighbouring frames get similar solutions.
    """
    still = torch.eye(3, dtype=dtype, device=device).expand(1, N_JOINTS, 3, 3)
    pose = torch.tensor(rest, dtype=dtype, device=device).unflatten(0, (N_JOINTS, 3))
    moved = jacobian(lambda turn: _joints(still, turn[None], pose)[0].flatten(), torch.zeros_like(pose))
    return (2 * moved.square().sum(0).mean(-1, keepdim=True) + LEVER).rsqrt()


class Curvature(NamedTuple):
    """The change of the gradient along a step that was taken, from which L-BFGS estimates the curvature.

    Attributes:
        x: change of the variables (N, D).
        gradient: change of the gradient (N, D).
        inverse: 1 / (their inner product) (N,), or 0 for a row whose step is not used.
    """

    x: Tensor
    gradient: Tensor
    inverse: Tensor


ARMIJO = 1e-4  # the share of the decrease promised by the slope that a step must reach
HALVINGS = 10  # step lengths tried, each half of the one before
CURVATURE = 1e-12  # a step's product with the gradient's change must exceed this times the latter's square


def minimise(objective: Objective, x: Tensor, iterations: int, history: int = 10) -> Tensor:
    """Run L-BFGS (Nocedal and Wright, Algorithm 7.4) on each row of x (N, D) separately.

    Each row has its own curvature and step length (halved from 1 until Armijo's condition holds), and stays
    unchanged when no step helps: the objective never rises.

    Returns:
        The variables (N, D) at the end.
    """
    everyone = torch.arange(len(x), device=x.device)
    value, gradient = value_and_gradient(objective, x, everyone)
    steps: list[Curvature] = []
    for _ in range(iterations):
        direction = -two_loop(gradient, steps)
        after, value = line_search(objective, x, value, gradient, direction)
        _, new_gradient = value_and_gradient(objective, after, everyone)
        steps = [*steps, curvature(after - x, new_gradient - gradient)][-history:]
        x, gradient = after, new_gradient
    return x


def value_and_gradient(objective: Objective, x: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Return the objective (N,) and its gradient (N, D)."""
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        value = objective(x, rows)
        (gradient,) = torch.autograd.grad(value.sum(), x)
    return value.detach(), gradient


def curvature(x: Tensor, gradient: Tensor) -> Curvature:
    """Return the curvature of a step from its changes (N, D); rows without positive curvature are unused."""
    product = (x * gradient).sum(-1)
    useful = product > CURVATURE * gradient.square().sum(-1)
    return Curvature(x, gradient, torch.where(useful, 1 / torch.where(useful, product, 1), 0))


def two_loop(gradient: Tensor, steps: list[Curvature]) -> Tensor:
    """Return the estimated inverse Hessian times the gradient (N, D), by the two-loop recursion."""
    q, weights = gradient, []
    for step in reversed(steps):
        weight = step.inverse * (step.x * q).sum(-1)
        q = q - weight[:, None] * step.gradient
        weights.append(weight)
    q = q * first_guess(gradient, steps)[:, None]
    for step, weight in zip(steps, reversed(weights), strict=True):
        q = q + (weight - step.inverse * (step.gradient * q).sum(-1))[:, None] * step.x
    return q


def first_guess(gradient: Tensor, steps: list[Curvature]) -> Tensor:
    """Return the first estimate of the inverse Hessian, a multiple (N,) of the identity.

    It comes from the row's newest usable step; without such a step, it limits the first step's length to 1.
    """
    length = 1 / gradient.norm(dim=-1).clamp_min(1)
    for step in steps:
        square = step.gradient.square().sum(-1)
        useful = step.inverse > 0
        length = torch.where(useful, 1 / torch.where(useful, step.inverse * square, 1), length)
    return length


def line_search(
    objective: Objective, x: Tensor, value: Tensor, gradient: Tensor, direction: Tensor
) -> tuple[Tensor, Tensor]:
    """Halve each row's step until it is good enough (Armijo's condition).

    Returns:
        Variables (N, D) and values (N,) after the step; a row for which no step is good enough is unchanged.
    """
    slope = (gradient * direction).sum(-1)
    rows = (slope < 0).nonzero()[:, 0]
    x, value, length = x.clone(), value.clone(), 1.0
    for _ in range(HALVINGS):
        trial = x[rows] + length * direction[rows]
        reached = objective(trial, rows)
        good = reached <= value[rows] + ARMIJO * length * slope[rows]
        x[rows[good]], value[rows[good]] = trial[good], reached[good]
        rows, length = rows[~good], length / 2
        if not len(rows):
            break
    return x, value
