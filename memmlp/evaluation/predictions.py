"""Files of a network's predictions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from torch import Tensor

from memmlp.evaluation import modes
from memmlp.evaluation.evaluation import Evaluation
from memmlp.evaluation.ik import IK, NoIK
from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.dataset import MotionDataset
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.window_model import WindowModel


def save_predictions(evaluation: Evaluation, model: WindowModel, test: MotionDataset, folder: Path) -> None:
    """Write `<folder>/<mode>/<clip>.npz` for every mode and test clip; see `prediction_arrays`."""
    clips = test.clips()
    for mode in evaluation.modes:
        motions = modes.predict(model, clips, mode, evaluation.batch)
        for name, clip, motion in zip(test.names, clips, motions, strict=True):
            path = folder / mode / f"{name}.npz"
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savez(
                path, allow_pickle=False, **prediction_arrays(model.normalizer, clip, motion, evaluation.ik)
            )


def predict_clip(model: WindowModel, clip: Tensor, mode: str) -> dict[str, np.ndarray]:
    """What a network makes of a clip's frames (N, 252) in a mode, beside the truth (`prediction_arrays`)."""
    return prediction_arrays(model.normalizer, clip, modes.MODE_FUNCTIONS[mode](model, [clip])[0], NoIK())


def prediction_arrays(normalizer: Normalizer, clip: Tensor, motion: Tensor, ik: IK) -> dict[str, np.ndarray]:
    """Return the content of a prediction file: metres in the world, local rotation matrices, float32.

    `predicted_positions` (N, 22, 3) are those of the rotation branch by forward kinematics, the head on its
    tracker. The result of inverse kinematics, if any, is in `combined_positions` and `combined_rotations`.
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
