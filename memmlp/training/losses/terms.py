"""A library of loss terms for any network (`TermsLoss`). All terms compare a predicted body with the true
body in the world. Positions are in metres, velocities in metres per frame."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import cached_property, partialmethod
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

from memmlp.common.components import component, find_chosen_settings
from memmlp.common.errors import InputError
from memmlp.common.settings import at_least, one_of, positive, setting
from memmlp.motion.body import HANDS, HEAD, N_JOINTS, ROOT, ROTATION, SPARSE_POSITION
from memmlp.motion.geometry import (
    complete_columns,
    compute_geodesic_angle,
    convert_almost_rotations,
    forward_kinematics,
    matrix_to_sixd,
    sixd_to_matrix,
)
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.layers import select_joints
from memmlp.training.losses.loss import (
    CompleteLossSettings,
    FixedWeights,
    Loss,
    Terms,
    UncertaintyWeights,
    Weighting,
    joints,
)

FEET = (7, 8, 10, 11)  # both ankles, both toes
TOES = (10, 11)
MAX_STANDING_MOVE = 0.01  # metres a frame, up to which a true foot stands


class BodyMotion:
    """A body's pose at each frame of world motion (B, T, 198), of which only rotations are used, with cached
    values that several terms need. `normalizer` provides the rest pose; `columns` is a key of
    TermsLossSettings."""

    def __init__(self, motion: Tensor, normalizer: Normalizer, columns: str | None = None):
        self.rest, self.columns = normalizer.rest, columns
        self.sixd = motion[..., ROTATION].unflatten(-1, (N_JOINTS, 6))

    @cached_property
    def local(self) -> Tensor:
        """The local rotations (B, T, 22, 3, 3)."""
        if self.columns == "released":
            return convert_almost_rotations(complete_columns(self.sixd))
        return sixd_to_matrix(self.sixd)

    @cached_property
    def global_pose(self) -> tuple[Tensor, Tensor]:
        """Global rotations (B, T, 22, 3, 3), and positions (B, T, 22, 3) with the pelvis at the origin."""
        pelvis = torch.zeros_like(self.local[..., ROOT, :, 0])
        rotations, positions = forward_kinematics(self.local, pelvis, self.rest)
        if self.columns == "released":
            rotations, _ = forward_kinematics(complete_columns(self.sixd), pelvis, self.rest)
        return rotations, positions

    @cached_property
    def turns(self) -> Tensor:
        """The rotations from each frame to the next (B, T - 1, 22, 3, 3), in the joints' own axes."""
        return self.local[:, :-1].transpose(-1, -2) @ self.local[:, 1:]


Error = Callable[[Tensor], Tensor]
"""Maps differences (..., n) to a number, the mean error."""

ERRORS: dict[str, Error] = {
    "absolute": lambda difference: difference.abs().mean(),
    "square": lambda difference: difference.square().mean(),
    "norm": lambda difference: difference.norm(dim=-1).mean(),
    "smooth": lambda difference: F.smooth_l1_loss(difference, torch.zeros_like(difference)),
}


class Comparison:
    """A predicted motion compared with the true motion, both in the world (B, T, 198), with inputs (B, T,
    54). Each weight of TermsLossSettings has a method with the same name, which returns the term. Positions
    are joints (B, T, 22, 3); the predicted ones have the head on its tracker."""

    def __init__(
        self,
        motion: Tensor,
        truth: Tensor,
        sparse: Tensor,
        normalizer: Normalizer,
        columns: str | None = None,
    ):
        self.predicted, self.truth = BodyMotion(motion, normalizer, columns), BodyMotion(truth, normalizer)
        self.head = sparse[..., SPARSE_POSITION][..., None, :3]
        self.true_positions = joints(truth)

    @cached_property
    def positions(self) -> Tensor:
        """The predicted joints (B, T, 22, 3), with the head on its tracker."""
        rooted = self.predicted.global_pose[1]
        return rooted + (self.head - rooted[..., HEAD : HEAD + 1, :])

    @cached_property
    def floor(self) -> Tensor:
        """The height (B, 1) of the lowest true joint of each window."""
        return self.true_positions[..., 2].flatten(1).amin(1, keepdim=True)

    @cached_property
    def standing(self) -> Tensor:
        """Whether each true foot stands still until the next frame (B, T - 1, 4)."""
        return self.true_positions[:, :, list(FEET)].diff(dim=1).norm(dim=-1) <= MAX_STANDING_MOVE

    def orientation(self, error: Error) -> Tensor:
        """Return the error of the root's 6D orientation."""
        return error((self.predicted.sixd - self.truth.sixd)[..., ROOT, :])

    def rotation(self, error: Error) -> Tensor:
        """Return the error of the local 6D rotations of all joints except the root."""
        return error((self.predicted.sixd - self.truth.sixd)[..., ROOT + 1 :, :])

    def global_rotation(self, error: Error) -> Tensor:
        """Return the error of all joints' global 6D rotations."""
        predicted, true = (matrix_to_sixd(one.global_pose[0]) for one in (self.predicted, self.truth))
        return error(predicted - true)

    def angle(self, error: Error) -> Tensor:
        """Return the mean angle between predicted and true global rotations, in radians."""
        return compute_geodesic_angle(self.predicted.global_pose[0], self.truth.global_pose[0]).mean()

    def sixd_velocity(self, error: Error) -> Tensor:
        """Return the error of the frame-to-frame differences of all local 6D rotations."""
        return error((self.predicted.sixd - self.truth.sixd).diff(dim=1))

    def turn(self, error: Error) -> Tensor:
        """Return the error of the joints' velocities on SO(3): the rotations from frame to frame, in 6D."""
        return error(matrix_to_sixd(self.predicted.turns) - matrix_to_sixd(self.truth.turns))

    def position_from_pelvis(self, error: Error) -> Tensor:
        """Return the error of joint positions relative to the pelvis, from forward kinematics."""
        true = self.true_positions - self.true_positions[..., ROOT : ROOT + 1, :]
        return error(self.predicted.global_pose[1] - true)

    def world_position(self, error: Error) -> Tensor:
        """Return the error of joint positions from forward kinematics, with the head on its tracker."""
        return error(self.positions - self.true_positions)

    def hand(self, error: Error) -> Tensor:
        """Return the error of both wrists' positions, with the head on its tracker."""
        return error(select_joints(self.positions - self.true_positions, HANDS))

    def velocity(self, error: Error, step: int = 1) -> Tensor:
        """Return the error of the joints' movement between every `step`-th frame."""
        return error((self.positions - self.true_positions)[:, ::step].diff(dim=1))

    velocity_3 = partialmethod(velocity, step=3)
    velocity_5 = partialmethod(velocity, step=5)

    def acceleration(self, error: Error) -> Tensor:
        """Return the error of the joints' second differences in time."""
        return error((self.positions - self.true_positions).diff(2, dim=1))

    def jerk(self, error: Error) -> Tensor:
        """Return the mean norm of the predicted joints' third differences in time; the truth is not used."""
        return measure_jerk(self.positions)

    def contact(self, error: Error) -> Tensor:
        """Return the error of the predicted feet's movement while the true feet stand still."""
        return error(select_joints(self.positions, FEET).diff(dim=1) * self.standing[..., None])

    def penetration(self, error: Error) -> Tensor:
        """Return how far the lowest predicted joint is below the window's floor, averaged over frames."""
        return F.relu(self.floor - self.positions[..., 2].amin(-1)).mean()

    def foot_height(self, error: Error) -> Tensor:
        """Return the mean distance of predicted toes from the floor while the true toes stand still."""
        standing = self.standing[..., [FEET.index(toe) for toe in TOES]]
        return ((self.positions[:, 1:, list(TOES), 2] - self.floor[..., None]).abs() * standing).mean()


def measure_jerk(positions: Tensor) -> Tensor:
    """Return the mean norm of the third differences in time of positions (B, T, 22, 3)."""
    return positions.diff(3, dim=1).norm(dim=-1).mean()


TERM_FRAMES = {
    "sixd_velocity": 2, "turn": 2, "velocity": 2, "velocity_3": 4, "velocity_5": 6, "acceleration": 3,
    "jerk": 4, "contact": 2, "foot_height": 2,
}  # fmt: skip
"""The number of frames for each term that needs more than one frame."""


@component("loss", "terms", builds="TermsLoss")
@dataclass
class TermsLossSettings(CompleteLossSettings):
    """A weighted sum of loss terms from a library; null leaves a term out.

    Options such as loss=ego_poser and loss=hmd_poser are presets of these weights.

    A network that learns only one frame of a window (AvatarPoser, EgoPoser, MANIKIN) cannot use terms that
    need several frames.
    """

    # measure of differences: absolute and square of components, norm of joints, or smooth (torch's smooth L1)
    error: str = setting(one_of("absolute", "square", "norm", "smooth"), "absolute")
    # learned: weights by uncertainty (Eq. 5), e^-s L + s, with one s for each term; the weights below are the
    # initial values of e^-s
    weighting: str = setting(one_of("fixed", "learned"), "fixed")
    lr: float = setting(positive(), 1.0e-2)  # learning rate of learned weights
    # released: positions and global rotations as in most released codes (docs/guides/published-weights.md),
    # whose 6D columns are not made orthonormal; null: orthonormal
    columns: str | None = setting(one_of("released"), None)
    orientation: float | None = setting(at_least(0), None)  # the root's 6D orientation
    rotation: float | None = setting(at_least(0), 1.0)  # the other joints' local 6D rotations
    global_rotation: float | None = setting(at_least(0), None)  # all joints' global 6D rotations
    # the angle between global rotations, in radians; ignores `error`
    angle: float | None = setting(at_least(0), None)
    # the differences of all local 6D rotations between consecutive frames
    sixd_velocity: float | None = setting(at_least(0), None)
    # velocity on SO(3): the relative rotations between consecutive frames, in 6D
    turn: float | None = setting(at_least(0), None)
    # joint positions from forward kinematics, relative to the pelvis, so without translation
    position_from_pelvis: float | None = setting(at_least(0), None)
    # joint positions from forward kinematics, with the head at its tracker
    world_position: float | None = setting(at_least(0), None)
    hand: float | None = setting(at_least(0), None)  # positions of both wrists, with the head at its tracker
    # the joints' movement between consecutive frames, with the head at its tracker
    velocity: float | None = setting(at_least(0), None)
    velocity_3: float | None = setting(at_least(0), None)  # the joints' movement over three frames
    velocity_5: float | None = setting(at_least(0), None)  # the joints' movement over five frames
    acceleration: float | None = setting(at_least(0), None)  # the second differences of the joints
    # the norm of the third differences of the predicted joints; does not depend on the true joints
    jerk: float | None = setting(at_least(0), None)
    # the movement of the predicted feet while the true feet move at most 1 cm per frame
    contact: float | None = setting(at_least(0), None)
    # the depth of the lowest predicted joint below the lowest true joint of the window
    penetration: float | None = setting(at_least(0), None)
    # the distance of the predicted toes from the lowest true joint's height while the true toes stand still
    foot_height: float | None = setting(at_least(0), None)

    rotations_alone: ClassVar[bool] = True

    @classmethod
    def problems(cls, config: Any) -> Iterator[str]:
        newest = getattr(find_chosen_settings(config, "model"), "learns_newest_frame", False)
        frames = 1 if newest else config["model"]["frames"]
        for name, needed in TERM_FRAMES.items():
            if config["loss"].get(name) is not None and frames < needed:
                yield f"loss.{name}: must be null, since it needs {needed} frames, but model learns {frames}"


TERMS = tuple(one.name for one in fields(TermsLossSettings) if one.type == float | None)
"""The names of the terms: the keys that are weights."""


class TermsLoss(Loss):
    """A weighted sum of the library's terms, used by most baselines; see TermsLossSettings for the arguments.
    None as the weight leaves a term out. Raises InputError if no term has a weight, or a learned weight would
    begin at 0."""

    def __init__(
        self,
        error: str = "absolute",
        weighting: str = "fixed",
        lr: float = 1e-2,
        columns: str | None = None,
        **weights: float | None,
    ):
        super().__init__()
        self.columns = columns
        chosen = {name: weight for name, weight in weights.items() if weight is not None}
        if not chosen:
            raise InputError(f"loss=terms: must have a weight for at least one of {', '.join(TERMS)}")
        self.error = ERRORS[error]
        self.weighting: Weighting = (
            UncertaintyWeights(lr, chosen) if weighting == "learned" else FixedWeights(chosen)
        )

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        pair = Comparison(motion, truth, sparse, normalizer, self.columns)
        return {name: getattr(pair, name)(self.error) for name in self.weighting.weights()}
