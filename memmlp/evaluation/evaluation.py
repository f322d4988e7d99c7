"""The stage that evaluates a trained network on the test clips."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from memmlp.evaluation import modes
from memmlp.evaluation.ik import IK
from memmlp.evaluation.metrics import UserMetrics
from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.dataset import MotionDataset
from memmlp.networks.motion_model import MotionModel

PICTURE_FRAMES = 600  # the first 10 s


@dataclass(frozen=True)
class Evaluation:
    """How a network is evaluated.

    Attributes:
        modes: the evaluation modes, out of "stream" and "window".
        batch: the largest number of clips that are evaluated side by side.
        ik: inverse kinematics, whose result is reported as one more branch.
        seed: seed for networks that draw random numbers, such as a sampled blend.
        metrics: custom metrics, by name.
    """

    modes: Sequence[str]
    batch: int
    ik: IK
    seed: int
    metrics: UserMetrics = field(default_factory=dict)

    def report(self, model: MotionModel, test: MotionDataset, mode: str) -> dict[str, Any]:
        """Compute the metrics in a mode.

        Returns:
            "mean", the metrics by branch, and "clips", a row for each clip with its metrics by branch; and
            "offline" for a network that can't run as a stream.
        """
        torch.manual_seed(self.seed)  # a mode's result does not depend on which modes came before it
        clips = test.clips()
        rows: list[dict[str, Any]] = []
        for index, motion in enumerate(modes.predict(model, clips, mode, self.batch)):
            facts = {"name": test.names[index], "group": test.groups[index]}
            facts |= {"source": test.sources[index]} if test.sources else {}
            errors = modes.clip_report(model.normalizer, motion, clips[index], self.ik, self.metrics)
            rows.append({**facts, "frames": len(clips[index]), **errors})
        branches = [{key: row[key] for key in errors} for row in rows]
        label = {} if model.is_stream else {"offline": True}
        return {"mean": modes.mean_of_clips(branches), "clips": rows, **label}


def predict_first_clip(model: MotionModel, test: MotionDataset) -> tuple[np.ndarray, np.ndarray]:
    """Return truth and prediction (N, 22, 3) of the first test clip's start, metres, world.

    The prediction is made by streaming, if the network can.
    """
    device = model.normalizer.rest.device
    clip = test.clip(0)[:PICTURE_FRAMES].to(device)
    motion = modes.MODE_FUNCTIONS["stream" if model.is_stream else "window"](model, [clip])[0]
    predicted = model.normalizer.pose(motion, clip[:, :SPARSE_DIM])
    truth = modes.joint_positions(clip[:, SPARSE_DIM:])
    return truth.cpu().numpy(), predicted.cpu().numpy()
