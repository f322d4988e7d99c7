"""The inverse-kinematics slot: local rotations that bring the pose to the position branch (App. A).

The paper runs L-BFGS for at most 15 iterations from the rotation branch's pose (Table 6, reading 11).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.functional import jacobian

from memmlp.motion.body import HEAD, N_JOINTS, POSITION, ROTATION, SPARSE_POSITION
from memmlp.motion.geometry import axis_angle_to_matrix, forward_kinematics, matrix_to_sixd, sixd_to_matrix
from memmlp.motion.normalizer import Normalizer

Objective = Callable[[Tensor, Tensor], Tensor]


class NoIK:
    """No third result beside the two branches."""

    def solutions(self, normalizer: Normalizer, motion: Tensor, sparse: Tensor) -> dict[str, Tensor]:
        """None."""
        return {}


@dataclass(frozen=True)
class LBFGS:
    """Table 6's "Rotation + Position Branch".

    The variables are an axis-angle increment for each joint, applied on the right of its predicted
    rotation: smooth around the start, without the redundant scale of 6D. The head stays on its tracker as
    in `Frame.pose`, so that what is minimised is what is measured. A rotation that moves no joint (those of
    the leaves) stays as predicted. In float64, so that a frame's result does not depend on its neighbours.

    Every frame is solved by itself. torch.optim.LBFGS (strong Wolfe) over a batch has one step length and one
    curvature for all its frames, so that a frame's result depends on which others stand beside it. Measured
    on 3000 streamed frames of CMU salsa, one thread, 15 iterations: from 3.13 cm between the branches to 0.98
    in 2 s, Jitter from 16.4 to 17.9; torch's to 1.02 in 5 s, Jitter 16.6.

    Attributes:
        iterations: at most.
        chunk: frames side by side.
    """

    iterations: int = 15
    chunk: int = 4096

    def solutions(self, normalizer: Normalizer, motion: Tensor, sparse: Tensor) -> dict[str, Tensor]:
        """The motion (N, 198) with the rotations that fit best, as "combined".

        Args:
            motion: predicted (N, 198), world. sparse: inputs (N, 54).
        """
        parts = zip(motion.split(self.chunk), sparse.split(self.chunk), strict=True)
        rotations = torch.cat([self.solve(normalizer, *part) for part in parts])
        return {"combined": torch.cat([rotations, motion[:, POSITION]], -1)}

    def solve(self, normalizer: Normalizer, motion: Tensor, sparse: Tensor) -> Tensor:
        """Rotations (N, 132) in 6D, frame by frame, whose joints are nearest to the position branch's."""
        start = sixd_to_matrix(motion[:, ROTATION].double().unflatten(-1, (N_JOINTS, 6)))
        head = sparse[:, SPARSE_POSITION][:, :3].double()
        target = motion[:, POSITION].double().unflatten(-1, (N_JOINTS, 3)) - head[:, None]
        distance = JointDistance(start, target, normalizer.rest.double())
        increment = minimise(distance, torch.zeros_like(start[..., 0]).flatten(1), self.iterations)
        return matrix_to_sixd(distance.turned(increment)).flatten(1).to(motion.dtype)


IK = NoIK | LBFGS


class JointDistance:
    """Sum over joints of the squared distance (m^2) to targets relative to the head, frame by frame.

    Args:
        start: local rotations (N, 22, 3, 3). target: metres (N, 22, 3). rest: rest positions (22, 3), metres.
    """

    LEVER = 0.1  # m^2, keeps the unit of a joint that moves little within bounds

    def __init__(self, start: Tensor, target: Tensor, rest: Tensor):
        self.start, self.target, self.rest = start, target, rest
        # A hip moves more than a wrist: in units of 1 / lever all variables bend the objective alike, so that
        # few iterations get far and neighbouring frames go the same way (without: 1.19 cm, Jitter 24).
        still = torch.eye(3).to(start).expand(1, N_JOINTS, 3, 3)
        moved = jacobian(
            lambda turn: self.joints(still, turn[None])[0].flatten(), torch.zeros_like(start[0, ..., 0])
        )
        self.unit = (2 * moved.square().sum(0).mean(-1, keepdim=True) + self.LEVER).rsqrt()

    def __call__(self, increment: Tensor, rows: Tensor) -> Tensor:
        """The objective (n,) at increments (n, 66) of those rows (n,)."""
        joints = self.joints(self.start[rows], self.turn(increment))
        return (joints - self.target[rows]).square().sum((1, 2))

    def turned(self, increment: Tensor) -> Tensor:
        """Local rotations (N, 22, 3, 3) after increments (N, 66)."""
        return self.start @ axis_angle_to_matrix(self.turn(increment))

    def turn(self, increment: Tensor) -> Tensor:
        """Increments (n, 66) as axis-angle (n, 22, 3)."""
        return increment.unflatten(-1, (N_JOINTS, 3)) * self.unit

    def joints(self, start: Tensor, turn: Tensor) -> Tensor:
        """Positions (n, 22, 3) relative to the head after turns (n, 22, 3) of rotations (n, 22, 3, 3)."""
        local = start @ axis_angle_to_matrix(turn)
        _, positions = forward_kinematics(local, torch.zeros_like(local[:, 0, 0]), self.rest)
        return positions - positions[:, HEAD : HEAD + 1]


class Curvature(NamedTuple):
    """A change of the variables and of the gradient (N, D), and 1 / their product (N,), 0 where useless."""

    x: Tensor
    gradient: Tensor
    inverse: Tensor


ARMIJO = 1e-4  # of the decrease that the slope promises
HALVINGS = 10
CURVATURE = 1e-12  # the least, relative to the gradient's change, for a step to say something of it


def minimise(objective: Objective, x: Tensor, iterations: int, history: int = 10) -> Tensor:
    """L-BFGS (Nocedal and Wright, Algorithm 7.4) on every row of x (N, D) by itself.

    Each row has its own curvature and step length (halved from 1 until Armijo's condition holds), and stays
    where no step helps: the objective never rises.
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
    """Objective (N,) and gradient (N, D)."""
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        value = objective(x, rows)
        (gradient,) = torch.autograd.grad(value.sum(), x)
    return value.detach(), gradient


def curvature(x: Tensor, gradient: Tensor) -> Curvature:
    """The step of these changes; none for a row without positive curvature."""
    product = (x * gradient).sum(-1)
    useful = product > CURVATURE * gradient.square().sum(-1)
    return Curvature(x, gradient, torch.where(useful, 1 / torch.where(useful, product, 1), 0))


def two_loop(gradient: Tensor, steps: list[Curvature]) -> Tensor:
    """The inverse Hessian's estimate times the gradient (N, D)."""
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
    """The inverse Hessian (N,) as a number: from the newest useful step, at first at most 1 / |gradient|."""
    length = 1 / gradient.norm(dim=-1).clamp_min(1)
    for step in steps:
        square = step.gradient.square().sum(-1)
        useful = step.inverse > 0
        length = torch.where(useful, 1 / torch.where(useful, step.inverse * square, 1), length)
    return length


def line_search(
    objective: Objective, x: Tensor, value: Tensor, gradient: Tensor, direction: Tensor
) -> tuple[Tensor, Tensor]:
    """Variables (N, D) and values (N,) after each row's largest of the halved steps that is good enough."""
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
