"""Prediction files: arrays together with the truth, and clips for other programs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_file
from memmlp.evaluation import modes
from memmlp.evaluation.ik import IK, NoIK
from memmlp.evaluation.modes import Evaluation
from memmlp.motion.body import FPS, SPARSE_DIM
from memmlp.motion.clip import SPLINES, Clip, resample
from memmlp.motion.dataset import MotionDataset
from memmlp.motion.exporting import ExportPlan, ExportReport, ExportTarget, convert_and_export
from memmlp.motion.normalizer import Normalizer
from memmlp.motion.preparing.cache import compute_frame_blocks
from memmlp.networks.motion_model import MotionModel

KINDS_OF_POSES = {"rotation": "predicted", "combined": "combined", "truth": "true"}
"""The branches that can be written as clips, with the prefix of their arrays (`make_prediction_arrays`)."""


def save_predictions(evaluation: Evaluation, model: MotionModel, test: MotionDataset, folder: Path) -> None:
    """Write `<folder>/<mode>/<clip>.npz` for every mode and test clip; see `make_prediction_arrays`."""
    clips = test.read_clips()
    for mode in evaluation.modes:
        torch.manual_seed(evaluation.seed)  # the same seed as for the mode's metrics
        motions = modes.predict(model, clips, mode, evaluation.batch)
        for name, clip, motion in zip(test.names, clips, motions, strict=True):
            path = folder / mode / f"{name}.npz"
            path.parent.mkdir(parents=True, exist_ok=True)
            arrays = make_prediction_arrays(model.normalizer, clip, motion, evaluation.ik)
            with atomic_file(path) as file:
                np.savez(file, allow_pickle=False, **arrays)


def predict_clip(model: MotionModel, clip: Tensor, mode: str) -> dict[str, np.ndarray]:
    """Return the prediction arrays of a clip (N, 252), with the truth; see `make_prediction_arrays`.

    Random numbers are seeded, so repeated calls return the same prediction.

    Raises:
        InputError: if mode is "stream" and the network uses future frames.
    """
    check_mode(model, mode)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        motion = modes.MODE_FUNCTIONS[mode](model, [clip])[0]
    return make_prediction_arrays(model.normalizer, clip, motion, NoIK())


def check_mode(model: MotionModel, mode: str) -> None:
    """Raise InputError if mode is "stream" and the network uses future frames."""
    if mode == "stream" and not model.is_stream:
        raise InputError("mode=stream: must be window for this network, which uses future frames")


def make_prediction_arrays(
    normalizer: Normalizer, clip: Tensor, motion: Tensor, ik: IK
) -> dict[str, np.ndarray]:
    """Return the content of a prediction file, float32.

    `*_positions` (N, 22, 3) are metres in the world; `*_rotations` (N, 22, 3, 3) are local, except that the
    root rotation is global.

    Returns:
        `predicted_positions`: by forward kinematics of `predicted_rotations`, with the head on its tracker.
        `predicted_positions_of_position_branch`: equal to `predicted_positions` if the network does not have
        a position branch.
        `true_positions` and `true_rotations`.
        `combined_positions` and `combined_rotations`: the result of inverse kinematics, if it is enabled.
    """
    sparse, truth = clip[:, :SPARSE_DIM], clip[:, SPARSE_DIM:]
    arrays = {
        "predicted_positions": normalizer.compute_positions(motion, sparse),
        "predicted_positions_of_position_branch": modes.extract_positions(motion),
        "true_positions": modes.extract_positions(truth),
        "predicted_rotations": modes.extract_rotations(motion),
        "true_rotations": modes.extract_rotations(truth),
    }
    for name, solved in ik.solutions(normalizer, motion, sparse).items():
        arrays[f"{name}_positions"] = normalizer.compute_positions(solved, sparse)
        arrays[f"{name}_rotations"] = modes.extract_rotations(solved)
    return {name: tensor.cpu().numpy() for name, tensor in arrays.items()}


def make_clip(name: str, rotations: np.ndarray, positions: np.ndarray, rest: np.ndarray) -> Clip:
    """Return motion as a clip at 60 Hz.

    Args:
        name: the clip's name.
        rotations: local rotations (N, 22, 3, 3); the root rotation is global.
        positions: joints (N, 22, 3), metres, world; only the root position is used.
        rest: the body's rest joints (22, 3), metres.
    """
    poses = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec()
    return Clip(name, poses.reshape(*rotations.shape[:2], 3), positions[:, 0] - rest[0], float(FPS))


@dataclass(frozen=True)
class ClipPredictor:
    """Predicts clips from recorded clips with a trained network.

    Attributes:
        model: the network.
        mode: "stream" or "window".
        branch: one of KINDS_OF_POSES. "rotation" is the rotation branch with the head on its tracker.
            "combined" is the result of inverse kinematics. "truth" is the recorded clip.
        evaluation: the evaluation settings: batch size, inverse kinematics, seed.
        interpolation: the method that resamples clips to 60 Hz; use the method of the training data.

    Raises:
        InputError: if mode is "stream" and the network uses future frames.
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
        """The rest joints (22, 3) of the network's body, metres."""
        return self.model.normalizer.rest.cpu().double().numpy()

    def predict(self, names: Sequence[str], clips: Sequence[Tensor]) -> list[Clip]:
        """Return the predicted clips at 60 Hz for recorded frames (N, 252)."""
        torch.manual_seed(self.evaluation.seed)
        clips = [clip.to(self.model.normalizer.rest.device) for clip in clips]
        ik = self.evaluation.ik if self.branch == "combined" else NoIK()
        if self.branch == "truth":  # does not need the network
            motions = [clip[:, SPARSE_DIM:] for clip in clips]
        else:
            motions = modes.predict(self.model, clips, self.mode, self.evaluation.batch)
        kind, made = KINDS_OF_POSES[self.branch], []
        for name, clip, motion in zip(names, clips, motions, strict=True):
            arrays = make_prediction_arrays(self.model.normalizer, clip, motion, ik)
            made.append(make_clip(name, arrays[f"{kind}_rotations"], arrays[f"{kind}_positions"], self.rest))
        return made

    def export(self, plan: ExportPlan, *, strict: bool = False) -> ExportReport:
        """Write the network's predictions for a plan's clips.

        Args:
            plan: the clips.
            strict: whether an unreadable file raises InputError. If False, it is skipped and reported.

        Raises:
            InputError: if every clip is unreadable, or a file cannot be written.
        """
        batch = self.evaluation.batch
        return convert_and_export(
            plan, self.rest, self._compute_frames, self.predict, batch=batch, strict=strict
        )

    def _compute_frames(self, target: ExportTarget, clip: Clip) -> Tensor:
        """Compute the frames (N, 252) of a clip on the network's body, like in a cache.

        Raises:
            InputError: if the clip has fewer than two frames at 60 Hz.
        """
        clip, _ = resample(clip, interpolation=self.interpolation)
        if len(clip) < 2:
            raise InputError(f"{target.source}: has one frame at {FPS} Hz; must have two or more")
        return torch.from_numpy(np.concatenate(list(compute_frame_blocks(clip, self.rest))))
