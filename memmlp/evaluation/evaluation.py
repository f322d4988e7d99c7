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

PICTURE_FRAMES = 600  # 10 s


@dataclass(frozen=True)
class Evaluation:
    """The settings of an evaluation.

    Attributes:
        modes: the evaluation modes: "stream", "window" or both.
        batch: maximum number of clips that are evaluated in parallel.
        ik: inverse kinematics; its result is reported like an additional branch.
        seed: random seed for networks with random outputs, such as a sampled blend.
        metrics: the custom metrics by name.
    """

    modes: Sequence[str]
    batch: int
    ik: IK
    seed: int
    metrics: UserMetrics = field(default_factory=dict)

    def report(self, model: MotionModel, test: MotionDataset, mode: str) -> dict[str, Any]:
        """Compute the metrics in a mode.

        Returns:
            "mean": the metrics by branch. "clips": a row per clip with its metrics by branch. "offline":
            True, only present if the network uses future frames.
        """
        torch.manual_seed(self.seed)  # each mode starts from the same seed
        clips = test.read_clips()
        rows: list[dict[str, Any]] = []
        for index, motion in enumerate(modes.predict(model, clips, mode, self.batch)):
            facts = {"name": test.names[index], "group": test.groups[index]}
            facts |= {"source": test.sources[index]} if test.sources else {}
            errors = modes.measure_clip(model.normalizer, motion, clips[index], self.ik, self.metrics)
            rows.append({**facts, "frames": len(clips[index]), **errors})
        branches = [{key: row[key] for key in errors} for row in rows]
        label = {} if model.is_stream else {"offline": True}
        mean = modes.average_clips(branches, [row["frames"] for row in rows])
        return {"mean": mean, "clips": rows, **label}


def predict_first_clip(model: MotionModel, test: MotionDataset) -> tuple[np.ndarray, np.ndarray]:
    """Return true and predicted joints (N, 22, 3) for the first 10 s of the first test clip, metres, world.

    The mode is "window" for networks that use future frames, and "stream" for all others.
    """
    device = model.normalizer.rest.device
    clip = test.read_clip(0)[:PICTURE_FRAMES].to(device)
    motion = modes.MODE_FUNCTIONS["stream" if model.is_stream else "window"](model, [clip])[0]
    predicted = model.normalizer.compute_positions(motion, clip[:, :SPARSE_DIM])
    truth = modes.extract_positions(clip[:, SPARSE_DIM:])
    return truth.cpu().numpy(), predicted.cpu().numpy()
