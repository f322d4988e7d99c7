"""What a file with lower precision costs in accuracy."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from torch import Tensor

from memmlp.common.progress import progress_bar
from memmlp.deploy.half_precision import rounded
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.deploy.parity import streamed
from memmlp.evaluation.metrics import positions_report
from memmlp.evaluation.modes import joint_positions, rotations_report
from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.runs.deployment_folder import accurate_enough

TEST_FRAMES = 20_000  # accuracy is measured on at most this many


def accuracy(path: Path, normalizer: Normalizer, clips: Sequence[Tensor]) -> dict[str, float]:
    """Measure the rotation branch's metrics, streamed in ONNX Runtime: means over clips (N, 252).

    "position MPJPE" is that of the file's positions: of the position branch, where the network has one.
    At most 20,000 frames are streamed; if there are more, the first part of each clip is, with the same share
    of all clips.
    """
    stream, share = OnnxStream(path), min(1.0, TEST_FRAMES / sum(map(len, clips)))
    rows = []
    for clip in progress_bar(clips, "measuring"):
        truth = clip[: max(int(share * len(clip)), 2)]
        motion = streamed(stream, truth)
        positions = joint_positions(motion), joint_positions(truth[:, SPARSE_DIM:])
        position = positions_report(*positions)["MPJPE"]
        rows.append(rotations_report(normalizer, motion, truth) | {"position MPJPE": position})
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def _rounded_copy(path: Path, folder: Path) -> Path:
    """Write the file, which is in fp16, as one that ONNX Runtime's CPU provider rounds to fp16."""
    copy = folder / "rounded.onnx"
    onnx.save(rounded(onnx.load(path)), copy)
    return copy


def compared(
    exact: Path, other: Path, precision: str, normalizer: Normalizer, clips: Sequence[Tensor]
) -> dict[str, Any]:
    """Measure on test clips what lower precision costs in accuracy.

    Args:
        exact: the float32 file.
        other: the same network with lower precision.
        precision: name of the lower precision, such as "int8".
        normalizer: the network's normalizer.
        clips: frames (N, 252) of each clip.

    Returns:
        The metrics of both files, the relative growth of MPJPE, of the branch in which that is larger, and of
        Jitter, and whether the other file may be the default (`accurate_enough`).
    """
    before = accuracy(exact, normalizer, clips)
    with tempfile.TemporaryDirectory() as folder:
        if precision == "fp16":
            other = _rounded_copy(other, Path(folder))
        after = accuracy(other, normalizer, clips)
    growths = {name: after[name] / before[name] - 1 for name in ("MPJPE", "position MPJPE", "Jitter")}
    jitter = growths.pop("Jitter")
    growth = float(np.max(list(growths.values())))  # NaN if either is
    grown = {"growth": growth, "jitter_growth": jitter}
    return {"fp32": before, precision: after, **grown, "default": accurate_enough(grown)}
