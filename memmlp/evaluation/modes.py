"""Evaluation in the two modes of the field, with all clips side by side in one batch.

The mode `stream` is live use: one frame at a time, on the network's own history, with only the last frame of
each window kept. The mode `window` is AGRoL's: non-overlapping windows, of which all T frames are kept. The
last call for a clip gets the remaining frames: its window ends with the clip and so overlaps the window
before, whose earlier estimates are kept.

Some networks are evaluated differently in window mode. A network that recalls the window which ended one
frame before gets each window frame by frame, as in its training: in one call it would get the window of T
frames ago. Its result for a window is the last call's output. A network without a window is a stream in both
modes. So is, to rounding, one that predicts each frame from the window that ends with it, as its authors
evaluate it. A network that predicts the windows of a clip together gets the whole clip
(`MotionModel.takes_whole_clip`), and can't be a stream.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from memmlp.common.progress import progress_bar
from memmlp.evaluation import metrics
from memmlp.evaluation.ik import IK, NoIK
from memmlp.motion.body import N_JOINTS, POSITION, ROTATION, SPARSE_DIM
from memmlp.motion.dataset import MotionDataset
from memmlp.motion.geometry import sixd_to_matrix
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.motion_model import MotionModel


def stream(network: MotionModel, clips: Sequence[Tensor]) -> list[Tensor]:
    """Predict the world motion (N, 198) of clips (N, 252), frame by frame."""
    return frame_by_frame(network, clips, 1)


def window(network: MotionModel, clips: Sequence[Tensor]) -> list[Tensor]:
    """Predict the world motion (N, 198) of clips (N, 252), by non-overlapping windows."""
    if network.windowless:
        return stream(network, clips)
    if network.takes_whole_clip:
        return clip_by_clip(network, clips)
    if 0 < network.shift < network.frames:
        return frame_by_frame(network, clips, network.frames)
    return window_by_window(network, clips)


@torch.no_grad()
def frame_by_frame(network: MotionModel, clips: Sequence[Tensor], size: int) -> list[Tensor]:
    """Predict the motion (N, 198) of clips (N, 252) by calls of one new frame each.

    The motion of each window of `size` frames (or fewer at a clip's end) comes from the call with the
    window's last frame. With `size` 1, this is a live stream.
    """
    order, lengths, inputs = _side_by_side(clips)
    motion = inputs.new_zeros(*inputs.shape[:2], POSITION.stop)
    state = network.initial_state(len(clips))
    active = len(clips)
    for t in progress_bar(range(lengths[0]), "stream", unit="frames"):
        while lengths[active - 1] <= t:  # the clips are sorted by length: the last ones end first
            active -= 1
            state = {name: tensor[:active] for name, tensor in state.items()}
        since = t - t % size
        output, state = network.advance(inputs[:active, t : t + 1], state, t + 1 - since)
        motion[:active, since : t + 1] = output[:, since - t - 1 :]  # overwrites earlier calls
    return [motion[order.index(i), : len(clip)] for i, clip in enumerate(clips)]


@torch.no_grad()
def window_by_window(network: MotionModel, clips: Sequence[Tensor]) -> list[Tensor]:
    """Predict the motion (N, 198) of clips (N, 252) by calls of T new frames, or the rest of a clip."""
    size = network.frames
    order, lengths, inputs = _side_by_side(clips)
    motion = inputs.new_zeros(*inputs.shape[:2], POSITION.stop)
    state = network.initial_state(len(clips))
    for start in range(0, lengths[0], size):
        remaining = torch.tensor([min(size, length - start) for length in lengths if length > start])
        for new in remaining.unique().tolist():  # ascending: only full windows go on, and they come last
            rows = (remaining == new).nonzero()[:, 0].to(inputs.device)
            rows_state = {name: tensor[rows] for name, tensor in state.items()}
            output, after = network.advance(inputs[rows, start : start + new], rows_state)
            motion[rows, start : start + new] = output[:, -new:]
        state = after
    return [motion[order.index(i), : len(clip)] for i, clip in enumerate(clips)]


@torch.no_grad()
def clip_by_clip(network: MotionModel, clips: Sequence[Tensor]) -> list[Tensor]:
    """Predict the motion (N, 198) of clips (N, 252), by one call for each whole clip."""
    inputs = []
    for clip in clips:  # at least T frames, by repeating the first one
        sparse = clip[:, :SPARSE_DIM]
        inputs.append(torch.cat([sparse[:1].expand(max(network.frames - len(clip), 0), -1), sparse]))
    motions = [
        network.predict_clip(sparse) for sparse in progress_bar(inputs, "windows together", unit="clips")
    ]
    return [motion[-len(clip) :] for motion, clip in zip(motions, clips, strict=True)]


MODE_FUNCTIONS: dict[str, Callable[[MotionModel, Sequence[Tensor]], list[Tensor]]] = {
    "window": window,
    "stream": stream,
}


def predict(network: MotionModel, clips: Sequence[Tensor], mode: str, batch: int) -> list[Tensor]:
    """Predict the motion (N, 198) of each clip (N, 252), with at most `batch` clips side by side."""
    groups = [clips[i : i + batch] for i in range(0, len(clips), batch)]
    return [motion for group in groups for motion in MODE_FUNCTIONS[mode](network, group)]


def clip_report(
    normalizer: Normalizer,
    motion: Tensor,
    truth: Tensor,
    ik: IK | None = None,
    custom: metrics.UserMetrics | None = None,
) -> dict[str, dict[str, float]]:
    """Return the metrics of both branches and of `ik`'s result, from motion (N, 198) and truth (N, 252)."""
    sparse, target = truth[:, :SPARSE_DIM], truth[:, SPARSE_DIM:]
    positions = joint_positions(motion), joint_positions(target)
    position = metrics.positions_report(*positions) | metrics.custom_report(
        custom or {}, "positions", *positions
    )
    report = {"rotation": rotations_report(normalizer, motion, truth, custom), "position": position}
    solved = (ik or NoIK()).solutions(normalizer, motion, sparse)
    return report | {name: rotations_report(normalizer, one, truth, custom) for name, one in solved.items()}


def rotations_report(
    normalizer: Normalizer, motion: Tensor, truth: Tensor, custom: metrics.UserMetrics | None = None
) -> dict[str, float]:
    """Return the metrics of the rotations in motion (N, 198) against the truth (N, 252).

    Position metrics are included; these positions follow from the rotations by forward kinematics, with the
    head on its tracker.
    """
    sparse, target = truth[:, :SPARSE_DIM], truth[:, SPARSE_DIM:]
    rotations = local_rotations(motion), local_rotations(target)
    positions = normalizer.pose(motion, sparse), joint_positions(target)
    report = metrics.rotations_report(*rotations) | metrics.positions_report(*positions)
    report |= metrics.custom_report(custom or {}, "rotations", *rotations)
    return report | metrics.custom_report(custom or {}, "positions", *positions)


def local_rotations(motion: Tensor) -> Tensor:
    """Return the rotation matrices (N, 22, 3, 3) of motion (N, 198)."""
    return sixd_to_matrix(motion[:, ROTATION].unflatten(-1, (N_JOINTS, 6)))


def joint_positions(motion: Tensor) -> Tensor:
    """Return the position branch's joints (N, 22, 3) in motion (N, 198), metres, world."""
    return motion[:, POSITION].unflatten(-1, (N_JOINTS, 3))


def cut_clips(dataset: MotionDataset, length: int, least: int) -> list[Tensor]:
    """Cut a dataset's clips into pieces of `length` frames.

    Pieces of fewer than `least` frames are left out, unless all pieces are that short.
    """
    pieces = [piece for clip in dataset.clips() for piece in clip.split(length)]
    return [p for p in pieces if len(p) >= least] or pieces


@torch.no_grad()
def measure_stream(
    network: MotionModel, pieces: Sequence[Tensor], custom: metrics.UserMetrics | None = None
) -> dict[str, float]:
    """Return the stream-mode metrics, averaged over pieces of clips, for validation during training."""
    motions = stream(network, pieces)
    pairs = zip(motions, pieces, strict=True)
    mean = mean_of_clips(
        [clip_report(network.normalizer, motion, piece, custom=custom) for motion, piece in pairs]
    )
    return {f"{branch} {name}": value for branch, values in mean.items() for name, value in values.items()}


def _side_by_side(clips: Sequence[Tensor]) -> tuple[list[int], list[int], Tensor]:
    """Return the clips' order, the longest first, their lengths in it, and padded inputs (B, N, 54)."""
    order = sorted(range(len(clips)), key=lambda i: -len(clips[i]))
    inputs = torch.nn.utils.rnn.pad_sequence([clips[i][:, :SPARSE_DIM] for i in order], batch_first=True)
    return order, [len(clips[i]) for i in order], inputs


def mean_of_clips(rows: Sequence[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Return each branch's metrics, mean over clips; clips that are too short for a metric are left out.

    A clip for which the network returned NaN is not left out: all means of that branch are then NaN.
    """
    return {
        branch: {name: _mean_of([row[branch] for row in rows], name) for name in values}
        for branch, values in rows[0].items()
    }


def _mean_of(rows: Sequence[dict[str, float]], name: str) -> float:
    if any(math.isnan(row["MPJPE"]) for row in rows):  # it is defined on the shortest clip
        return math.nan
    return float(torch.tensor([row[name] for row in rows]).nanmean())
