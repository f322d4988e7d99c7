"""Files of a network's predictions: as arrays together with the truth, and as clips for other programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from memmlp.common.errors import InputError
from memmlp.evaluation import modes
from memmlp.evaluation.evaluation import Evaluation
from memmlp.evaluation.ik import IK, NoIK
from memmlp.motion.body import FPS, SPARSE_DIM
from memmlp.motion.clip import SPLINES, Clip, resample
from memmlp.motion.dataset import MotionDataset
from memmlp.motion.exporting import ExportPlan, ExportReport, Target, export_converted
from memmlp.motion.normalizer import Normalizer
from memmlp.motion.preparing.cache import frame_blocks
from memmlp.networks.motion_model import MotionModel

KINDS_OF_POSES = {"rotation": "predicted", "combined": "combined", "truth": "true"}
"""Branches that can be written as clips -> the beginnings of their arrays' names (`prediction_arrays`)."""


def save_predictions(evaluation: Evaluation, model: MotionModel, test: MotionDataset, folder: Path) -> None:
    """Write `<folder>/<mode>/<clip>.npz` for every mode and test clip; see `prediction_arrays`."""
    clips = test.clips()
    for mode in evaluation.modes:
        torch.manual_seed(evaluation.seed)  # as for the mode's metrics
        motions = modes.predict(model, clips, mode, evaluation.batch)
        for name, clip, motion in zip(test.names, clips, motions, strict=True):
            path = folder / mode / f"{name}.npz"
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savez(
                path, allow_pickle=False, **prediction_arrays(model.normalizer, clip, motion, evaluation.ik)
            )


def predict_clip(model: MotionModel, clip: Tensor, mode: str) -> dict[str, np.ndarray]:
    """Return a network's prediction of a clip's frames (N, 252), beside the truth (`prediction_arrays`).

    A network that draws random numbers draws the same ones for a clip each time.

    Raises:
        InputError: for the stream of a network that can't run as a stream.
    """
    check_mode(model, mode)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        motion = modes.MODE_FUNCTIONS[mode](model, [clip])[0]
    return prediction_arrays(model.normalizer, clip, motion, NoIK())


def check_mode(model: MotionModel, mode: str) -> None:
    """Raise InputError for the stream of a network that uses future frames."""
    if mode == "stream" and not model.is_stream:
        raise InputError("mode=stream: must be window for this network, which uses future frames")


def prediction_arrays(normalizer: Normalizer, clip: Tensor, motion: Tensor, ik: IK) -> dict[str, np.ndarray]:
    """Return the content of a prediction file, float32.

    `*_positions` (N, 22, 3) are metres in the world; `*_rotations` (N, 22, 3, 3) are local, except for the
    root's, which is global.

    Returns:
        `predicted_positions` by forward kinematics of `predicted_rotations`, with the head on its tracker;
        `predicted_positions_of_position_branch`, which are the same for a network without such a branch;
        `true_positions` and `true_rotations`; `combined_positions` and `combined_rotations` from inverse
        kinematics, if any.
    """
    sparse, truth = clip[:, :SPARSE_DIM], clip[:, SPARSE_DIM:]
    arrays = {
        "predicted_positions": normalizer.pose(motion, sparse),
        "predicted_positions_of_position_branch": modes.joint_positions(motion),
        "true_positions": modes.joint_positions(truth),
        "predicted_rotations": modes.local_rotations(motion),
        "true_rotations": modes.local_rotations(truth),
    }
    for name, solved in ik.solutions(normalizer, motion, sparse).items():
        arrays[f"{name}_positions"] = normalizer.pose(solved, sparse)
        arrays[f"{name}_rotations"] = modes.local_rotations(solved)
    return {name: tensor.cpu().numpy() for name, tensor in arrays.items()}


def motion_clip(name: str, rotations: np.ndarray, positions: np.ndarray, rest: np.ndarray) -> Clip:
    """Return motion as a clip at 60 Hz on the body with rest joints (22, 3), metres.

    Args:
        name: the clip's name.
        rotations: local rotations (N, 22, 3, 3), except for the root's, which is global.
        positions: joints (N, 22, 3), metres, world; only the root's are used, the others follow.
        rest: the body's rest joints.
    """
    poses = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec()
    return Clip(name, poses.reshape(*rotations.shape[:2], 3), positions[:, 0] - rest[0], float(FPS))


@dataclass(frozen=True)
class ClipPredictor:
    """Makes predicted clips from recorded clips, with a trained network.

    Attributes:
        model: the network.
        mode: "stream" or "window".
        branch: one of KINDS_OF_POSES: the rotation branch with the head on its tracker, the result of the
            evaluation's inverse kinematics, or the truth, which is the recorded clip itself.
        evaluation: how the network is evaluated: batches, inverse kinematics, seed.
        interpolation: how clips of other rates are brought to 60 Hz, as those of the network's training were.

    Raises:
        InputError: for the stream of a network that can't run as a stream.
    """

    model: MotionModel
    mode: str
    branch: str
    evaluation: Evaluation
    interpolation: str = SPLINES

    def __post_init__(self) -> None:
        check_mode(self.model, self.mode)

    @property
    def rest(self) -> np.ndarray:
        """Rest joints (22, 3), metres, of the body that the network was trained on."""
        return self.model.normalizer.rest.cpu().double().numpy()

    def predict(self, names: Sequence[str], clips: Sequence[Tensor]) -> list[Clip]:
        """Return the network's predictions for clips' frames (N, 252), as clips of N frames at 60 Hz."""
        torch.manual_seed(self.evaluation.seed)
        clips = [clip.to(self.model.normalizer.rest.device) for clip in clips]
        ik = self.evaluation.ik if self.branch == "combined" else NoIK()
        if self.branch == "truth":  # without the network
            motions = [clip[:, SPARSE_DIM:] for clip in clips]
        else:
            motions = modes.predict(self.model, clips, self.mode, self.evaluation.batch)
        return [
            self._clip(name, prediction_arrays(self.model.normalizer, clip, motion, ik))
            for name, clip, motion in zip(names, clips, motions, strict=True)
        ]

    def _clip(self, name: str, arrays: Mapping[str, np.ndarray]) -> Clip:
        kind = KINDS_OF_POSES[self.branch]
        return motion_clip(name, arrays[f"{kind}_rotations"], arrays[f"{kind}_positions"], self.rest)

    def export(self, plan: ExportPlan, *, strict: bool = False) -> ExportReport:
        """Write the network's predictions for a plan's clips.

        Args:
            plan: the clips.
            strict: whether a bad file raises InputError; otherwise it is skipped and reported, if other files
                can be read.

        Raises:
            InputError: if no clip could be read, or a file cannot be written.
        """
        batch = self.evaluation.batch
        return export_converted(plan, self.rest, self._frames, self.predict, batch=batch, strict=strict)

    def _frames(self, target: Target, clip: Clip) -> Tensor:
        """Compute a clip's frames (N, 252) on the network's body as in a cache.

        Raises:
            InputError: if the clip has fewer than two frames at 60 Hz.
        """
        clip, _ = resample(clip, interpolation=self.interpolation)
        if len(clip) < 2:
            raise InputError(f"{target.source}: one frame at {FPS} Hz; must be two or more for a velocity")
        return torch.from_numpy(np.concatenate(list(frame_blocks(clip, self.rest))))
