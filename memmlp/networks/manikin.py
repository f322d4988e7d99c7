"""MANIKIN (Jiang et al., ECCV 2024): networks predict trunk and limb ends, and the limbs are solved.

MANIKIN-S uses AvatarPoser's encoder, MANIKIN-L uses AvatarJLM's network. A closed-form solver makes a pose
from their predictions for a frame (`PredictedParts`; memmlp.networks.limb_solver). Our readings: heights are
world heights, because a stream does not know its clip's lowest foot. The head has its tracker's rotation. A
straight limb does not keep the swivel of the previous frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from memmlp.common import distributed
from memmlp.common.components import component
from memmlp.common.settings import at_least, fraction, setting, tuned
from memmlp.motion.body import (
    HEAD,
    N_JOINTS,
    PARENTS,
    POSITION,
    ROOT,
    ROTATION,
    SPARSE_DIM,
    SPARSE_POSITION,
    SPARSE_ROTATION,
    TRACKED,
)
from memmlp.motion.geometry import forward_kinematics, matrix_to_sixd, sixd_to_matrix
from memmlp.motion.network_coordinates import Heading
from memmlp.motion.normalizer import Normalizer, use_float32
from memmlp.networks.avatar_jlm import AvatarJLM, AvatarJLMGraph, AvatarJLMSettings
from memmlp.networks.avatar_poser import AvatarPoser, AvatarPoserGraph, AvatarPoserSettings, make_head
from memmlp.networks.layers import replace_joints, select_joints
from memmlp.networks.limb_solver import (
    ANKLES,
    BASES,
    ENDS,
    IDENTITY,
    MIDDLES,
    TOES,
    measure_swivels,
    place_middle,
    solve_limbs,
)
from memmlp.networks.motion_model import MotionModel, State, TrainingOutputs
from memmlp.networks.transformer import initialize_weights

PREDICTED_JOINTS = (1, 2, 3, 6, 9, 12, 13, 14, 16, 17)
"""The joints with predicted local rotations besides the root: trunk, shoulders and hips."""
SWIVELS, PLACES = 2 * len(BASES), 3 * (len(ANKLES) + len(TOES))
PREDICTED_SIZE = 6 * (1 + len(PREDICTED_JOINTS)) + SWIVELS + PLACES
SOURCE = "eth-siplab/MANIKIN 24f4931"
BUFFERS = ("motion_net.ident_pose", "motion_net.keep_slots")
AUXILIARY_SIZE = 6 * (N_JOINTS - 1)  # rotations that MANIKIN-L predicts in training alone


def is_placed_by_trunk(joint: int) -> bool:
    """Return whether the predicted rotations determine a joint's position."""
    parent = PARENTS[joint]
    return parent <= ROOT or (parent in PREDICTED_JOINTS and is_placed_by_trunk(parent))


PLACED_JOINTS = [joint for joint in range(N_JOINTS) if is_placed_by_trunk(joint)]


class PredictedParts(NamedTuple):
    """The network's predictions for a frame, in the network's coordinates without z-scores.

    Attributes:
        sixd: the local 6D rotations (..., 11, 6) of the root and of the joints PREDICTED_JOINTS.
        swivel: cosines and sines (..., 4, 2) of the limbs' swivels, of any size.
        ankle: both ankles relative to the head (..., 2, 3), metres.
        toe: both toes relative to their ankles (..., 2, 3), metres.
    """

    sixd: Tensor
    swivel: Tensor
    ankle: Tensor
    toe: Tensor

    @classmethod
    def from_outputs(cls, outputs: Tensor, normalizer: Normalizer) -> PredictedParts:
        """Split a network's outputs (..., 86 or more) into parts."""
        chosen = [ROOT, *PREDICTED_JOINTS]
        mean, std = (
            part[SPARSE_DIM:][ROTATION].unflatten(0, (N_JOINTS, 6))[chosen]
            for part in (normalizer.mean, normalizer.std)
        )
        rotations, swivel, ankle, toe = outputs[..., :PREDICTED_SIZE].split(
            [6 * len(chosen), SWIVELS, 6, 6], -1
        )
        return cls(
            rotations.unflatten(-1, (len(chosen), 6)) * std + mean,
            swivel.unflatten(-1, (2, -1)).transpose(-1, -2),
            *(part.unflatten(-1, (2, 3)) for part in (ankle, toe)),
        )

    @property
    def trunk(self) -> Tensor:
        """The local rotations (..., 22, 3, 3) of a body; joints without a prediction have the identity."""
        rotations = sixd_to_matrix(self.sixd)
        identity = rotations.new_tensor(IDENTITY).expand(*rotations.shape[:-3], N_JOINTS, 3, 3)
        return replace_joints(identity, (ROOT, *PREDICTED_JOINTS), rotations, -3)

    def pose_body(self, rest: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the trunk, its global rotations (..., 22, 3, 3), and joints (..., 22, 3) from the pelvis."""
        trunk = self.trunk
        return trunk, *forward_kinematics(trunk, torch.zeros_like(trunk[..., ROOT, :, 0]), rest)

    def solve_pose(self, encoded: Tensor, normalizer: Normalizer) -> Tensor:
        """Solve the limbs for inputs (..., 54), and return rotations (..., 132) in network space."""
        seen = encoded * normalizer.std[:SPARSE_DIM] + normalizer.mean[:SPARSE_DIM]
        places = seen[..., SPARSE_POSITION].unflatten(-1, (len(TRACKED), 3))
        trackers = sixd_to_matrix(seen[..., SPARSE_ROTATION].unflatten(-1, (len(TRACKED), 6)))
        trunk, turned, joints = self.pose_body(normalizer.rest)
        anchor = places[..., :1, :]
        joints = joints + (anchor - joints[..., HEAD : HEAD + 1, :])
        local = solve_limbs(
            trunk,
            turned,
            select_joints(joints, BASES),
            torch.cat([places[..., 1:, :], anchor + self.ankle], -2),
            F.normalize(self.swivel, dim=-1),
            trackers[..., 1:, :, :],
            self.toe,
            normalizer.rest,
        )
        neck = turned[..., PARENTS[HEAD] : PARENTS[HEAD] + 1, :, :]
        head = neck.transpose(-1, -2) @ trackers[..., :1, :, :]
        sixd = matrix_to_sixd(replace_joints(local, [HEAD], head, -3)).flatten(-2)
        return (sixd - normalizer.mean[SPARSE_DIM:][ROTATION]) / normalizer.std[SPARSE_DIM:][ROTATION]


class TrueParts:
    """The true values for comparison with the predicted parts of a frame.

    Args:
        motion: true motion (..., 198), in the network's coordinates without z-scores.
    """

    def __init__(self, motion: Tensor):
        self.sixd = motion[..., ROTATION].unflatten(-1, (N_JOINTS, 6))
        self.joints = motion[..., POSITION].unflatten(-1, (N_JOINTS, 3))

    def list_limb_joints(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return the bases, middles and ends (..., 4, 3) of the limbs."""
        base, middle, end = (self.joints[..., list(joints), :] for joints in (BASES, MIDDLES, ENDS))
        return base, middle, end

    def compute_vectors(self, joints: tuple[int, ...], others: tuple[int, ...]) -> Tensor:
        """Return the vectors (..., n, 3) from `joints` to `others`."""
        return self.joints[..., list(others), :] - self.joints[..., list(joints), :]


class Manikin(MotionModel):
    """The base class of both MANIKIN networks, with their limb solver and training.

    The motion losses compare the solved pose; their gradients reach every predicted part through the solver.
    The authors' losses compare the predicted parts themselves.

    Attributes:
        parts_weight: weight of all losses of the parts.
        turned: whether training windows are turned by random headings.
    """

    parts_weight: float
    turned: bool

    def predict_parts(self, encoded: Tensor) -> Tensor:
        """Map windows (B, T, 54) in network space to outputs (B, n, 86 or more) for their last n frames."""
        raise NotImplementedError

    def compute_part_losses(self, outputs: Tensor, truth: TrueParts) -> dict[str, Tensor]:
        """Return the parts' losses for outputs (B, n, 86 or more), with the authors' weights."""
        raise NotImplementedError

    def solve_pose(self, outputs: Tensor, encoded: Tensor) -> Tensor:
        """Map outputs (..., 86 or more) and inputs (..., 54) of the same frames to rotations (..., 132).

        Limbs are always solved in float32.
        """
        with use_float32(outputs.device):
            return PredictedParts.from_outputs(outputs.to(encoded.dtype), self.normalizer).solve_pose(
                encoded, self.normalizer
            )

    def compute_training_outputs(self, sparse: Tensor, state: State, true_frames: Tensor) -> TrainingOutputs:
        """Predict the motion of windows turned by random headings, with losses; see MotionModel."""
        inputs, kept = self.append_inputs(sparse, state)
        angle = self.turned * 2 * math.pi * distributed.draw_rows(torch.rand_like, true_frames[:, :1, :1])
        heading = torch.cat([torch.zeros_like(true_frames[:, :1, :3]), angle.cos(), angle.sin()], -1)
        space = Heading()
        window = space.convert_inputs_to_local(inputs[:, -self.frames :], heading)
        encoded = self.normalizer.encode_sparse(window, self.normalizer.find_origin(window))
        outputs = self.predict_parts(encoded)
        count = outputs.shape[1]
        rotation = self.solve_pose(outputs, encoded[:, -count:])
        motion = space.convert_motion_to_world(
            self.normalizer.decode_rotations(rotation, window[:, -count:]), heading
        )
        true_window = torch.cat(
            [window, space.convert_motion_to_local(true_frames[..., SPARSE_DIM:], heading)], -1
        )
        return TrainingOutputs(motion, kept, self.compute_losses(outputs, true_window))

    def compute_losses(self, outputs: Tensor, true_frames: Tensor) -> dict[str, Tensor]:
        """Return the weighted losses of outputs (B, n, 86 or more), given true world frames (B, T, 252)."""
        motion = self.normalizer.coordinates.convert_motion_to_local(
            true_frames[..., SPARSE_DIM:], self.normalizer.find_origin(true_frames[..., :SPARSE_DIM])
        )
        with use_float32(outputs.device):
            parts = self.compute_part_losses(
                outputs.to(true_frames.dtype), TrueParts(motion[:, -outputs.shape[1] :])
            )
        return {name: self.parts_weight * term for name, term in parts.items()}


class ManikinSGraph(AvatarPoserGraph):
    """MANIKIN-S's streaming graph: AvatarPoser's graph, then the limb solver for the newest frame."""

    float32_modules: tuple[str, ...] = (*AvatarPoserGraph.float32_modules, "model.swivel", "model.places")
    model: ManikinS

    def read(self, newest: Tensor, encoded: Tensor) -> Tensor:
        return self.model.solve_pose(self.model.read(newest), encoded)


@component("model", "manikin_s", version=3, builds="ManikinS")
@dataclass
class ManikinSSettings(AvatarPoserSettings):
    """MANIKIN-S (Jiang et al. 2024): AvatarPoser's encoder predicts trunk, swivels, ankles and toes.

    Arms and legs are solved in closed form, so the hands are on their trackers. Losses follow its released
    code, which does not use dropout. Heights are world heights; the released code subtracts the clip's lowest
    foot. Training uses AdamW with the profile's schedule.
    """

    dropout: float = setting(fraction(), 0.0)  # dropout in the encoder during training
    # weight of the losses for the limb solver's inputs: trunk, swivel angles, elbows, knees, ankles and toes
    parts_weight: float = setting(at_least(0), 1.0)
    # weight of the loss for the root's 6D columns before they are made orthonormal; 0.02 with
    # loss.orientation=0 as in the released code
    root_weight: float = setting(at_least(0), 0.0)
    turned: bool = setting(default=True)  # true: rotate training windows to random headings

    defaults: ClassVar = {"loss": "manikin_s"}
    release: ClassVar = replace(
        AvatarPoserSettings.release,
        source=SOURCE,
        names=AvatarPoserSettings.release.names
        | {"swivel.*.*": "swivel_decoder.*.*", "places.*.*": "ankle_position_decoder.*.*"},
        unused=(*AvatarPoserSettings.release.unused, "ident_pose", "keep_slots"),
    )
    recipe: ClassVar = tuned(2.0e-3)


class ManikinS(Manikin, AvatarPoser):
    """MANIKIN-S: AvatarPoser's encoder with heads for root, rotations, swivels, ankles and toes.

    It has 4,244,566 parameters at the paper's sizes, which are AvatarPoser's sizes.
    """

    graph = ManikinSGraph
    rotated_joints: ClassVar[int] = len(PREDICTED_JOINTS)

    def __init__(self, normalizer: Normalizer, settings: ManikinSSettings):
        super().__init__(normalizer, settings)
        self.parts_weight, self.turned = settings.parts_weight, settings.turned
        self.root_weight = settings.root_weight
        self.swivel, self.places = make_head(settings.width, SWIVELS), make_head(settings.width, PLACES)
        for added in (self.swivel, self.places):
            initialize_weights(added)

    def read(self, newest: Tensor) -> Tensor:
        """Map the newest frame's feature (..., d) to outputs (..., 86)."""
        return torch.cat([super().read(newest), self.swivel(newest), self.places(newest)], -1)

    def predict_parts(self, encoded: Tensor) -> Tensor:
        """Map windows (B, T, 54) in network space to outputs (B, 1, 86) for their last frame."""
        return self.encode(self.embedding(encoded))[:, None]

    def predict_rotations(self, encoded: Tensor) -> Tensor:
        return self.solve_pose(self.predict_parts(encoded), encoded[:, -1:])[:, 0]

    def compute_part_losses(self, outputs: Tensor, truth: TrueParts) -> dict[str, Tensor]:
        """Return the parts' losses for outputs (B, 1, 86), with the authors' weights.

        Swivels are measured relative to the predicted shoulders and hips, without a gradient to them. That
        gradient has no bound if a limb is nearly parallel to its reference axis, like a standing leg, and
        training diverged. The losses of middles and swivels are sums over the limbs.
        """
        parts = PredictedParts.from_outputs(outputs, self.normalizer)
        _, turned, joints = parts.pose_body(self.normalizer.rest)
        base, middle, end = truth.list_limb_joints()
        up, angle = turned[..., list(BASES), :, 1].detach(), F.normalize(parts.swivel, dim=-1)
        lengths = [(one - other).norm(dim=-1, keepdim=True) for one, other in ((base, middle), (middle, end))]
        rooted = (truth.joints - truth.joints[..., ROOT : ROOT + 1, :])[..., PLACED_JOINTS, :]
        root = {"root": self.root_weight * F.l1_loss(parts.sixd[..., 0, :], truth.sixd[..., ROOT, :])}
        limbs = len(BASES)
        return (root if self.root_weight else {}) | {
            "trunk_rotation": F.l1_loss(parts.sixd[..., 1:, :], truth.sixd[..., list(PREDICTED_JOINTS), :]),
            "trunk_position": 5 * F.l1_loss(joints[..., PLACED_JOINTS, :], rooted),
            "swivel": 0.1 * 2 * limbs * F.l1_loss(parts.swivel, measure_swivels(base, middle, end, up)),
            "middle": limbs * F.l1_loss(place_middle(base, end, up, angle, *lengths), middle),
            "ankle": 5 * F.l1_loss(parts.ankle, truth.compute_vectors((HEAD,), ANKLES)),
            "toe": 0.3 * F.l1_loss(parts.toe, truth.compute_vectors(ANKLES, TOES)),
        }


class ManikinLGraph(AvatarJLMGraph):
    """MANIKIN-L's streaming graph: AvatarJLM's graph, then the limb solver for the newest frame."""

    model: ManikinL

    def read(self, outputs: Tensor, encoded: Tensor) -> Tensor:
        return self.model.solve_pose(outputs, encoded)


@component("model", "manikin_l", version=2, builds="ManikinL")
@dataclass
class ManikinLSettings(AvatarJLMSettings):
    """MANIKIN-L (Jiang et al. 2024): AvatarJLM's network predicts trunk, swivels, ankles and toes.

    Arms and legs are solved in closed form. MANIKIN-LN uses the same weights with model.offline=true
    evaluation.modes=[window] export.graph=off. Losses follow its released code. Training uses AdamW with the
    profile's schedule.
    """

    # weight of the losses for the limb solver's inputs: rotations, swivel angles, ankles and toes
    parts_weight: float = setting(at_least(0), 1.0)
    turned: bool = setting(default=True)  # true: rotate training windows to random headings
    # true: MANIKIN-LN, with windows that do not overlap; cannot stream
    offline: bool = setting(default=False)

    defaults: ClassVar = {"loss": "manikin_l"}
    release: ClassVar = replace(
        AvatarJLMSettings.release,
        source=SOURCE,
        sizes={
            "model.width": ("position_embedding.weight", 0),
            "model.depth": "motion_net.transformer.STEblocks.*.layers.0.linear1.weight",
            "model.feedforward": ("motion_net.transformer.STEblocks.0.layers.0.linear1.weight", 0),
        },
        unused=(*AvatarJLMSettings.release.unused, "motion_net.J_rest", "motion_net.kintree22", *BUFFERS),
    )
    recipe: ClassVar = {"optim.lr": "${profile.lr}", "optim.warmup": 0}  # not searched


class ManikinL(Manikin, AvatarJLM):
    """MANIKIN-L: AvatarJLM's network; its regressor predicts the parts and, in training, all rotations.

    It has 63,889,240 parameters at the paper's sizes, which are AvatarJLM's sizes. The authors' MANIKIN-LN
    uses the same weights for all frames of non-overlapping windows, so it cannot run as a live stream. Its
    raising of ankles to the true floor is left out here.
    """

    graph = ManikinLGraph
    outputs: ClassVar[int] = PREDICTED_SIZE + AUXILIARY_SIZE

    def __init__(self, normalizer: Normalizer, settings: ManikinLSettings):
        super().__init__(normalizer, settings)
        self.parts_weight, self.turned = settings.parts_weight, settings.turned
        self.is_stream = not settings.offline

    @staticmethod
    def read_coarse_pose(sixd: Tensor) -> tuple[Tensor, Tensor]:
        """Return the coarse pose's local rotations (..., 22, 3, 3) twice; see AvatarJLM."""
        rotations = sixd_to_matrix(sixd)
        return rotations, rotations

    def predict_parts(self, encoded: Tensor) -> Tensor:
        """Map windows (B, T, 54) in network space to outputs (B, T, 212) for all their frames."""
        return self.regress(encoded)

    def predict_rotations(self, encoded: Tensor) -> Tensor:
        return self.solve_pose(self.predict_parts(encoded), encoded)

    def compute_losses(self, outputs: Tensor, true_frames: Tensor) -> dict[str, Tensor]:
        """Return the weighted losses of the parts and of the coarse pose; see Manikin."""
        return super().compute_losses(outputs, true_frames) | self.compute_coarse_loss(true_frames)

    def compute_part_losses(self, outputs: Tensor, truth: TrueParts) -> dict[str, Tensor]:
        """Return the parts' losses for outputs (B, T, 212), with the authors' weights.

        Swivels are compared as angles relative to the true shoulders and hips. Toes are compared with the
        head on its tracker.
        """
        parts = PredictedParts.from_outputs(outputs, self.normalizer)
        turned, _ = forward_kinematics(
            sixd_to_matrix(truth.sixd), torch.zeros_like(truth.joints[..., ROOT, :]), self.normalizer.rest
        )
        true_swivels = measure_swivels(*truth.list_limb_joints(), turned[..., list(BASES), :, 1])
        (x, y), (cosine, sine) = parts.swivel.unbind(-1), true_swivels.unbind(-1)
        toe = truth.compute_vectors((HEAD,), TOES)
        return {
            "trunk_rotation": 2
            * F.l1_loss(parts.sixd[..., 1:, :], truth.sixd[..., list(PREDICTED_JOINTS), :]),
            "swivel": 0.1 * torch.atan2(y * cosine - x * sine, x * cosine + y * sine).abs().mean(),
            "ankle": 5 * F.l1_loss(parts.ankle, truth.compute_vectors((HEAD,), ANKLES)),
            "toe": 5 * F.l1_loss(parts.ankle + parts.toe, toe),
            "auxiliary": 2 * F.l1_loss(outputs[..., PREDICTED_SIZE:], truth.sixd[..., 1:, :].flatten(-2)),
        }
