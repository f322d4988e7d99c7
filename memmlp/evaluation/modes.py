"""Evaluation in the two standard modes, with all clips in parallel in one batch.

The mode `stream` simulates live use. The network gets one frame at a time and uses its own history. Only the
last frame of each window is kept.

The mode `window` follows AGRoL. The windows do not overlap, and all T frames of each window are kept. The
last window of a clip ends with the clip. So it overlaps the previous window. In the overlap, the estimates of
the previous window are kept.

Some networks are evaluated differently in window mode:

- A network that recalls the window one frame earlier gets each window frame by frame, like in training. The
  output of the last call is the result for the window.
- A network without a window is evaluated like a stream.
- A network that predicts each frame from the window ending there gives the same results as a stream, up to
  rounding. Its authors evaluate it in this way.
- A network that predicts all windows together gets the whole clip (`MotionModel.takes_whole_clip`). It does
  not support the mode `stream`."""

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from memmlp.common.progress import progress_bar
from memmlp.evaluation import metrics
from memmlp.evaluation.ik import IK, NoIK
from memmlp.evaluation.metric_facts import AUTHORS, MIN_FRAMES, MetricSet
from memmlp.evaluation.metrics import UserMetrics, measure_as_released
from memmlp.motion.body import N_JOINTS, POSITION, ROTATION, SPARSE_DIM
from memmlp.motion.dataset import MotionDataset
from memmlp.motion.geometry import (
    complete_columns,
    convert_almost_rotations,
    matrix_to_sixd,
    sixd_to_matrix,
)
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.motion_model import MotionModel

CHECKED_FRAMES = 8  # frames of a stream that are computed both together and one by one
MAX_WINDOWS = 16  # in a call of a stream's evaluation; with more clips, one for each clip
MIXED_FRAMES = 4  # frames at the end of two clips that are computed both together and beside a copy


def predict_stream(
    network: MotionModel, clips: Sequence[Tensor], max_windows: int = MAX_WINDOWS
) -> list[Tensor]:
    """Predict the world motion (N, 198) of clips (N, 252) frame by frame, as `predict_frame_by_frame`."""
    return predict_frame_by_frame(network, clips, 1, max_windows)


def predict_windows(
    network: MotionModel, clips: Sequence[Tensor], max_windows: int = MAX_WINDOWS
) -> list[Tensor]:
    """Predict the world motion (N, 198) of clips (N, 252) in non-overlapping windows."""
    if network.windowless:
        return predict_stream(network, clips, max_windows)
    if network.takes_whole_clip:
        return predict_clip_by_clip(network, clips)
    if 0 < network.shift < network.frames:
        return predict_frame_by_frame(network, clips, network.frames)
    return predict_window_by_window(network, clips)


@torch.no_grad()
def predict_frame_by_frame(
    network: MotionModel, clips: Sequence[Tensor], size: int, max_windows: int = MAX_WINDOWS
) -> list[Tensor]:
    """Predict the motion (N, 198) of clips (N, 252) frame by frame.

    The last frame of each `size` frames gives the motion for all of them; a clip's last ones may be fewer.
    With `size` 1, this is a live stream. A network call then computes several frames if that gives the same
    motion (`MotionModel.advance_frames`): with windows at most `max_windows` for all clips, or one for each.
    """
    order, lengths, inputs = _sort_and_pad(clips)
    calls = _plan_calls(lengths, network.frames_per_call if size == 1 else 1, network.windowless, max_windows)
    most = max(end - t for t, end, _ in calls)
    if most > 1 and not can_join_frames(network, inputs, min(most, CHECKED_FRAMES)):
        calls = _plan_calls(lengths, 1, network.windowless, max_windows)
    motion = inputs.new_zeros(*inputs.shape[:2], POSITION.stop)
    state = network.initial_state(len(clips))
    for t, end, active in progress_bar(calls, "stream", unit="calls"):
        state = {name: tensor[:active] for name, tensor in state.items()}
        if size == 1:
            motion[:active, t:end], state = network.advance_frames(inputs[:active, t:end], state)
        else:
            since = t - t % size
            output, state = network.advance(inputs[:active, t:end], state, end - since)
            motion[:active, since:end] = output[:, since - end :]  # overwrites earlier calls
    return [motion[order.index(i), : len(clip)] for i, clip in enumerate(clips)]


def _plan_calls(
    lengths: Sequence[int], most: int, windowless: bool, max_windows: int
) -> list[tuple[int, int, int]]:
    """Return the first frame, the end and the number of clips of each call, with at most `most` frames."""
    calls, t = [], 0
    while t < lengths[0]:
        active = sum(length > t for length in lengths)  # sorted by length, so the last ones end first
        count = most if windowless else max(1, min(most, max_windows // active))
        calls.append((t, min(t + count, lengths[0]), active))
        t += count
    return calls


@torch.no_grad()
def can_join_frames(network: MotionModel, inputs: Tensor, count: int) -> bool:
    """Return whether `count` frames of the first of inputs (B, N, 54) give the same motion in one call as one
    by one. They are far apart, so they differ even if a person first stands still."""
    begin = inputs[:1, :: max(1, inputs.shape[1] // count)][:, :count]
    state, singly = network.initial_state(1), []
    with _keep_random_state(inputs):
        together, _ = network.advance_frames(begin, state)
        for frame in begin.unbind(1):
            motion, state = network.advance_frame(frame, state)
            singly.append(motion)
    return torch.allclose(together, torch.stack(singly, 1), atol=1e-3)


@torch.no_grad()
def predict_window_by_window(network: MotionModel, clips: Sequence[Tensor]) -> list[Tensor]:
    """Predict the motion (N, 198) of clips (N, 252). Each call gets T new frames, or the remaining ones."""
    size = network.frames
    order, lengths, inputs = _sort_and_pad(clips)
    motion = inputs.new_zeros(*inputs.shape[:2], POSITION.stop)
    state = network.initial_state(len(clips))
    for start in range(0, lengths[0], size):
        remaining = torch.tensor([min(size, length - start) for length in lengths if length > start])
        for new in remaining.unique().tolist():  # ascending: only full windows continue, and they come last
            rows = (remaining == new).nonzero()[:, 0].to(inputs.device)
            rows_state = {name: tensor[rows] for name, tensor in state.items()}
            output, after = network.advance(inputs[rows, start : start + new], rows_state)
            motion[rows, start : start + new] = output[:, -new:]
        state = after
    return [motion[order.index(i), : len(clip)] for i, clip in enumerate(clips)]


@torch.no_grad()
def predict_clip_by_clip(network: MotionModel, clips: Sequence[Tensor]) -> list[Tensor]:
    """Predict the motion (N, 198) of clips (N, 252) with one call per clip."""
    inputs = []
    for clip in clips:  # repeat the first frame to get at least T frames
        sparse = clip[:, :SPARSE_DIM]
        inputs.append(torch.cat([sparse[:1].expand(max(network.frames - len(clip), 0), -1), sparse]))
    motions = [
        network.predict_clip(sparse) for sparse in progress_bar(inputs, "windows together", unit="clips")
    ]
    return [motion[-len(clip) :] for motion, clip in zip(motions, clips, strict=True)]


MODE_FUNCTIONS: dict[str, Callable[..., list[Tensor]]] = {
    "window": predict_windows,
    "stream": predict_stream,
}


def predict(network: MotionModel, clips: Sequence[Tensor], mode: str, batch: int) -> list[Tensor]:
    """Predict the motion (N, 198) of each clip (N, 252), with at most `batch` clips or windows in a call. If
    a network mixes the clips of a batch, it gets one clip at a time."""
    size = 1 if batch > 1 and mixes_clips(network, clips) else batch
    groups = [clips[i : i + size] for i in range(0, len(clips), size)]
    return [motion for group in groups for motion in MODE_FUNCTIONS[mode](network, group, size)]


def _keep_random_state(like: Tensor) -> AbstractContextManager[None]:
    return torch.random.fork_rng([like.device] if like.is_cuda else [])


@torch.no_grad()
def mixes_clips(network: MotionModel, clips: Sequence[Tensor]) -> bool:
    """Return whether the motion of the first of clips (N, 252) depends on the clip beside it in a batch."""
    if network.takes_whole_clip or len(clips) < 2:
        return False
    count = min(MIXED_FRAMES, *map(len, clips[:2]))
    first, second = (clip[-count:, :SPARSE_DIM] for clip in clips[:2])
    motions = []
    for other in (first, second):
        with _keep_random_state(first):  # both draw the same numbers
            state = network.initial_state(2)
            for frame in torch.stack([first, other]).split(1, 1):
                motion, state = network.advance(frame, state, 1)
        motions.append(motion[0])
    return not torch.allclose(motions[0], motions[1], atol=1e-4, equal_nan=True)


def measure_clip(
    normalizer: Normalizer,
    motion: Tensor,
    truth: Tensor,
    ik: IK | None = None,
    custom: metrics.UserMetrics | None = None,
    metric_set: MetricSet | None = None,
) -> dict[str, dict[str, float]]:
    """Return the metrics of one clip by branch, also for the result of `ik` and as in a released test.

    Args:
        normalizer: the network's normalizer.
        motion: predicted motion (N, 198), world.
        truth: inputs and true motion (N, 252), world.
        ik: inverse kinematics; None for no additional branch.
        custom: the custom metrics by name.
        metric_set: the released test; the branch "authors" has its metrics, unless it leaves the clip out.
    """
    sparse, target = truth[:, :SPARSE_DIM], truth[:, SPARSE_DIM:]
    positions = extract_positions(motion), extract_positions(target)
    position = metrics.measure_positions(*positions) | metrics.compute_custom_metrics(
        custom or {}, "positions", *positions
    )
    report = {"rotation": measure_rotation_branch(normalizer, motion, truth, custom), "position": position}
    if metric_set:
        marked = mark_invalid_rotations(motion)
        read = marked if metric_set.orthonormal else read_released_rotations(marked)
        rotations = extract_rotations(read), extract_rotations(target)
        placed = normalizer.compute_positions(read, sparse), positions[1]
        report |= {AUTHORS: found} if (found := measure_as_released(metric_set, rotations, placed)) else {}
    solved = (ik or NoIK()).solutions(normalizer, motion, sparse)
    return report | {
        name: measure_rotation_branch(normalizer, one, truth, custom) for name, one in solved.items()
    }


def measure_rotation_branch(
    normalizer: Normalizer, motion: Tensor, truth: Tensor, custom: metrics.UserMetrics | None = None
) -> dict[str, float]:
    """Return the metrics of the rotation branch in motion (N, 198) against the truth (N, 252).

    They include position metrics. Forward kinematics computes these positions from the rotations, with the
    head on its tracker.
    """
    sparse, target = truth[:, :SPARSE_DIM], truth[:, SPARSE_DIM:]
    motion = mark_invalid_rotations(motion)
    rotations = extract_rotations(motion), extract_rotations(target)
    positions = normalizer.compute_positions(motion, sparse), extract_positions(target)
    report = metrics.measure_rotations(*rotations) | metrics.measure_positions(*positions)
    report |= metrics.compute_custom_metrics(custom or {}, "rotations", *rotations)
    return report | metrics.compute_custom_metrics(custom or {}, "positions", *positions)


def mark_invalid_rotations(motion: Tensor) -> Tensor:
    """Return motion (N, 198) with NaN for 6D rotations whose columns are zero or parallel."""
    columns = extract_rotations(motion).norm(dim=-2)  # Gram-Schmidt leaves zero columns short
    valid = (columns > 0.5).all(-1).repeat_interleave(6, dim=-1)
    marked = motion.clone()
    marked[:, ROTATION] = torch.where(valid, motion[:, ROTATION], math.nan)
    return marked


def read_released_rotations(motion: Tensor) -> Tensor:
    """Return motion (N, 198) with the rotations that released codes read from its 6D columns; only columns
    that are not orthonormal change."""
    columns = complete_columns(motion[:, ROTATION].unflatten(-1, (N_JOINTS, 6)))
    sixd = matrix_to_sixd(convert_almost_rotations(columns)).flatten(-2)
    return torch.cat([sixd, motion[:, POSITION]], -1)


def extract_rotations(motion: Tensor) -> Tensor:
    """Return the rotation matrices (N, 22, 3, 3) of motion (N, 198)."""
    return sixd_to_matrix(motion[:, ROTATION].unflatten(-1, (N_JOINTS, 6)))


def extract_positions(motion: Tensor) -> Tensor:
    """Return the joint positions (N, 22, 3) of the position branch from motion (N, 198), metres, world."""
    return motion[:, POSITION].unflatten(-1, (N_JOINTS, 3))


def cut_clips(dataset: MotionDataset, length: int, least: int) -> list[Tensor]:
    """Cut a dataset's clips into pieces of `length` frames.

    Pieces shorter than `least` frames are dropped, unless all pieces are shorter.
    """
    pieces = [piece for clip in dataset.read_clips() for piece in clip.split(length)]
    return [p for p in pieces if len(p) >= least] or pieces


@torch.no_grad()
def measure_stream(
    network: MotionModel, pieces: Sequence[Tensor], custom: metrics.UserMetrics | None = None
) -> dict[str, float]:
    """Return the stream-mode metrics, averaged over pieces of clips. Validation during training uses them.

    A mean over only a part of the pieces is NaN.
    """
    motions = predict_stream(network, pieces)
    pairs = zip(motions, pieces, strict=True)
    mean = average_clips(
        [measure_clip(network.normalizer, motion, piece, custom=custom) for motion, piece in pairs],
        [max(map(len, pieces))] * len(pieces),
    )
    return {f"{branch} {name}": value for branch, values in mean.items() for name, value in values.items()}


def _sort_and_pad(clips: Sequence[Tensor]) -> tuple[list[int], list[int], Tensor]:
    """Sort clips by length and pad them.

    Returns:
        The clips' indices, longest clip first; the lengths in this order; the padded inputs (B, N, 54).
    """
    order = sorted(range(len(clips)), key=lambda i: -len(clips[i]))
    inputs = torch.nn.utils.rnn.pad_sequence([clips[i][:, :SPARSE_DIM] for i in order], batch_first=True)
    return order, [len(clips[i]) for i in order], inputs


def average_clips(
    rows: Sequence[dict[str, dict[str, float]]], frames: Sequence[int]
) -> dict[str, dict[str, float]]:
    """Return the mean metrics of each branch over clips with this branch; clips that are too short for a
    metric are skipped.

    A mean is NaN if any other clip has no value. If the network returned NaN for a clip, all means of the
    branch are NaN.

    Args:
        rows: the metrics of each clip by branch.
        frames: the number of frames of each clip.
    """
    means = {}
    for branch, values in {name: own for row in rows for name, own in row.items()}.items():
        having = [index for index, row in enumerate(rows) if branch in row]
        own, counts = [rows[index][branch] for index in having], [frames[index] for index in having]
        means[branch] = {name: _average_metric(own, counts, name) for name in values}
    return means


def _average_metric(rows: Sequence[dict[str, float]], frames: Sequence[int], name: str) -> float:
    if any(math.isnan(row["MPJPE"]) for row in rows):  # MPJPE is defined even for the shortest clip
        return math.nan
    long = [row[name] for row, number in zip(rows, frames, strict=True) if number >= MIN_FRAMES.get(name, 1)]
    return float(torch.tensor(long).mean()) if long else math.nan


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
        metric_set: the released test whose metrics are measured, too; None for none.
    """

    modes: Sequence[str]
    batch: int
    ik: IK
    seed: int
    metrics: UserMetrics = field(default_factory=dict)
    metric_set: MetricSet | None = None

    def report(self, model: MotionModel, test: MotionDataset, mode: str) -> dict[str, Any]:
        """Compute the metrics in a mode.

        Returns:
            "mean": the metrics by branch. "clips": a row per clip with its metrics by branch. "offline":
            True, only present if the network uses future frames.
        """
        torch.manual_seed(self.seed)  # each mode starts from the same seed
        clips = test.read_clips()
        rows: list[dict[str, Any]] = []
        branches = []
        for index, motion in enumerate(predict(model, clips, mode, self.batch)):
            facts = {"name": test.names[index], "group": test.groups[index]}
            facts |= {"source": test.sources[index]} if test.sources else {}
            scored = motion, clips[index], self.ik, self.metrics, self.metric_set
            branches.append(measure_clip(model.normalizer, *scored))
            rows.append({**facts, "frames": len(clips[index]), **branches[-1]})
        label = {} if model.is_stream else {"offline": True}
        mean = average_clips(branches, [row["frames"] for row in rows])
        return {"mean": mean, "clips": rows, **label}


def predict_first_clip(model: MotionModel, test: MotionDataset) -> tuple[np.ndarray, np.ndarray]:
    """Return true and predicted joints (N, 22, 3) for the first 10 s of the first test clip, metres, world.

    The mode is "window" for networks that use future frames, and "stream" for all others.
    """
    device = model.normalizer.rest.device
    clip = test.read_clip(0)[:PICTURE_FRAMES].to(device)
    motion = MODE_FUNCTIONS["stream" if model.is_stream else "window"](model, [clip])[0]
    predicted = model.normalizer.compute_positions(motion, clip[:, :SPARSE_DIM])
    truth = extract_positions(clip[:, SPARSE_DIM:])
    return truth.cpu().numpy(), predicted.cpu().numpy()
