"""A library of loss terms, from which any network's loss can be put together (`TermsLoss`).

All terms compare a predicted body with the true one in the world, in metres, and in metres per frame for
velocities.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial

import torch
import torch.nn.functional as F
from torch import Tensor

from memmlp.common.errors import InputError
from memmlp.motion.body import HANDS, HEAD, N_JOINTS, ROOT, ROTATION, SPARSE_POSITION
from memmlp.motion.geometry import forward_kinematics, geodesic_angle, matrix_to_sixd, sixd_to_matrix
from memmlp.motion.normalizer import Normalizer
from memmlp.training.losses.loss import Fixed, LearnedWeights, Loss, Terms, Weighting, joints

FEET = (7, 8, 10, 11)  # both ankles, both toes
TOES = (10, 11)
STANDING = 0.01  # metres a frame, up to which a true foot stands


class Body:
    """A body at each frame; values that several terms need are computed once, when first used.

    Args:
        motion: world motion (B, T, 198), of which only the rotations are used.
        normalizer: has the rest pose.
    """

    def __init__(self, motion: Tensor, normalizer: Normalizer):
        self.rest = normalizer.rest
        self.sixd = motion[..., ROTATION].unflatten(-1, (N_JOINTS, 6))

    @cached_property
    def local(self) -> Tensor:
        """The local rotations (B, T, 22, 3, 3)."""
        return sixd_to_matrix(self.sixd)

    @cached_property
    def posed(self) -> tuple[Tensor, Tensor]:
        """Global rotations (B, T, 22, 3, 3), and positions (B, T, 22, 3) with the pelvis at the origin."""
        return forward_kinematics(self.local, torch.zeros_like(self.local[..., ROOT, :, 0]), self.rest)

    @cached_property
    def turns(self) -> Tensor:
        """The rotations from each frame to the next (B, T - 1, 22, 3, 3), in the joints' own axes."""
        return self.local[:, :-1].transpose(-1, -2) @ self.local[:, 1:]


class Comparison:
    """A predicted motion and the true one, to be compared.

    Args:
        motion: predicted world motion (B, T, 198).
        truth: true world motion (B, T, 198).
        sparse: world inputs (B, T, 54).
        normalizer: has the rest pose.

    Attributes:
        positions: predicted joints (B, T, 22, 3), with the head on its tracker.
        true_positions: true joints (B, T, 22, 3).
    """

    def __init__(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer):
        self.made, self.true = Body(motion, normalizer), Body(truth, normalizer)
        self.head = sparse[..., SPARSE_POSITION][..., None, :3]
        self.true_positions = joints(truth)

    @cached_property
    def positions(self) -> Tensor:
        """The predicted joints (B, T, 22, 3), with the head on its tracker."""
        rooted = self.made.posed[1]
        return rooted + (self.head - rooted[..., HEAD : HEAD + 1, :])

    @cached_property
    def floor(self) -> Tensor:
        """The height (B, 1) of the lowest true joint of each window."""
        return self.true_positions[..., 2].flatten(1).amin(1, keepdim=True)

    @cached_property
    def standing(self) -> Tensor:
        """Which of the true feet stand (B, T - 1, 4): those that hardly move to the next frame."""
        return self.true_positions[:, :, list(FEET)].diff(dim=1).norm(dim=-1) <= STANDING


Error = Callable[[Tensor], Tensor]
"""Maps differences (..., n) to a number, the mean error."""

ERRORS: dict[str, Error] = {
    "absolute": lambda difference: difference.abs().mean(),
    "square": lambda difference: difference.square().mean(),
    "norm": lambda difference: difference.norm(dim=-1).mean(),
    "smooth": lambda difference: F.smooth_l1_loss(difference, torch.zeros_like(difference)),
}


def orientation(pair: Comparison, error: Error) -> Tensor:
    """Return the error of the root's 6D orientation."""
    return error((pair.made.sixd - pair.true.sixd)[..., ROOT, :])


def rotation(pair: Comparison, error: Error) -> Tensor:
    """Return the error of the other joints' local 6D rotations."""
    return error((pair.made.sixd - pair.true.sixd)[..., ROOT + 1 :, :])


def global_rotation(pair: Comparison, error: Error) -> Tensor:
    """Return the error of all joints' global 6D rotations."""
    return error(matrix_to_sixd(pair.made.posed[0]) - matrix_to_sixd(pair.true.posed[0]))


def angle(pair: Comparison, error: Error) -> Tensor:
    """Return the mean angle between predicted and true global rotations, in radians."""
    return geodesic_angle(pair.made.posed[0], pair.true.posed[0]).mean()


def sixd_velocity(pair: Comparison, error: Error) -> Tensor:
    """Return the error of the frame-to-frame differences of all local 6D rotations."""
    return error((pair.made.sixd - pair.true.sixd).diff(dim=1))


def turn(pair: Comparison, error: Error) -> Tensor:
    """Return the error of the joints' velocities on SO(3): the rotations from frame to frame, in 6D."""
    return error(matrix_to_sixd(pair.made.turns) - matrix_to_sixd(pair.true.turns))


def position_from_pelvis(pair: Comparison, error: Error) -> Tensor:
    """Return the error of the joints by forward kinematics relative to the pelvis, without translation."""
    true = pair.true_positions - pair.true_positions[..., ROOT : ROOT + 1, :]
    return error(pair.made.posed[1] - true)


def world_position(pair: Comparison, error: Error) -> Tensor:
    """Return the error of the joints by forward kinematics, with the head on its tracker."""
    return error(pair.positions - pair.true_positions)


def hand(pair: Comparison, error: Error) -> Tensor:
    """Return the error of both wrists' positions, with the head on its tracker."""
    return error((pair.positions - pair.true_positions)[..., list(HANDS), :])


def velocity(pair: Comparison, error: Error, step: int) -> Tensor:
    """Return the error of the joints' movement between every `step`-th frame."""
    return error((pair.positions - pair.true_positions)[:, ::step].diff(dim=1))


def acceleration(pair: Comparison, error: Error) -> Tensor:
    """Return the error of the joints' second differences in time."""
    return error((pair.positions - pair.true_positions).diff(2, dim=1))


def jerk(pair: Comparison, error: Error) -> Tensor:
    """Return the mean norm of the predicted joints' third differences in time; the truth is not used."""
    return measure_jerk(pair.positions)


def measure_jerk(positions: Tensor) -> Tensor:
    """Return the mean norm of the third differences in time of positions (B, T, 22, 3)."""
    return positions.diff(3, dim=1).norm(dim=-1).mean()


def contact(pair: Comparison, error: Error) -> Tensor:
    """Return the error of the predicted feet's movement while the true feet stand still."""
    return error(pair.positions[:, :, list(FEET)].diff(dim=1) * pair.standing[..., None])


def penetration(pair: Comparison, error: Error) -> Tensor:
    """Return how far the lowest predicted joint is below the window's floor, averaged over frames."""
    return F.relu(pair.floor - pair.positions[..., 2].amin(-1)).mean()


def foot_height(pair: Comparison, error: Error) -> Tensor:
    """Return the mean distance of predicted toes from the window's floor while the true toes stand still."""
    standing = pair.standing[..., [FEET.index(toe) for toe in TOES]]
    return ((pair.positions[:, 1:, list(TOES), 2] - pair.floor[..., None]).abs() * standing).mean()


TERMS: dict[str, tuple[Callable[[Comparison, Error], Tensor], int]] = {
    "orientation": (orientation, 1),
    "rotation": (rotation, 1),
    "global_rotation": (global_rotation, 1),
    "angle": (angle, 1),
    "sixd_velocity": (sixd_velocity, 2),
    "turn": (turn, 2),
    "position_from_pelvis": (position_from_pelvis, 1),
    "world_position": (world_position, 1),
    "hand": (hand, 1),
    "velocity": (partial(velocity, step=1), 2),
    "velocity_3": (partial(velocity, step=3), 4),
    "velocity_5": (partial(velocity, step=5), 6),
    "acceleration": (acceleration, 3),
    "jerk": (jerk, 4),
    "contact": (contact, 2),
    "penetration": (penetration, 1),
    "foot_height": (foot_height, 2),
}
"""Each term, and how many frames it needs."""


WEIGHTINGS: dict[str, Callable[[dict[str, float], float], Weighting]] = {
    "fixed": lambda weights, lr: Fixed(weights),
    "learned": LearnedWeights,
}


class TermsLoss(Loss):
    """A weighted sum of the library's terms; most baselines' losses are such sums.

    Args:
        error: how differences become a number where a term leaves it open: "absolute" (mean absolute
            components), "square" (mean squared ones), "norm" (mean L2 norms of joints), "smooth" (Huber's, as
            torch's smooth L1).
        weighting: "fixed" for weights that stay, "learned" for learned weights that begin at the given ones.
        lr: learning rate of the learned weights' s.
        weights: weights by the names of TERMS; None leaves a term out.

    Raises:
        InputError: if no term has a weight, or a learned weight would begin at 0.
    """

    def __init__(
        self, error: str = "absolute", weighting: str = "fixed", lr: float = 1e-2, **weights: float | None
    ):
        super().__init__()
        chosen = {name: weight for name, weight in weights.items() if weight is not None}
        if not chosen:
            raise InputError(f"loss=terms: no term has a weight; allowed are {', '.join(TERMS)}")
        self.error = ERRORS[error]
        self.weighting = WEIGHTINGS[weighting](chosen, lr)

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return each term by name, from motion and truth (B, T, 198) and inputs (B, T, 54) in the world.

        Raises:
            InputError: if a term needs more frames than the motion has, as with networks that learn one frame
                per window.
        """
        pair, frames = Comparison(motion, truth, sparse, normalizer), motion.shape[1]
        found = {}
        for name in self.weighting.weights():
            term, needed = TERMS[name]
            if frames < needed:
                raise InputError(
                    f"loss.{name}: needs {needed} frames of each window, and this network learns {frames}; "
                    f"allowed is loss.{name}=null"
                )
            found[name] = term(pair, self.error)
        return found
