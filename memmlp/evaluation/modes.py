"""Evaluation in the two modes of the field, with all clips side by side in one batch.

The mode `stream` is live use: one frame at a time, on the network's own history, with only the last frame of
each window kept. The mode `window` is AGRoL's: non-overlapping windows, all of whose T frames are kept. The
last call for a clip takes in the frames that are left: its window ends with the clip and so reaches back onto
frames of the window before, whose earlier estimates are kept.

Some networks are evaluated otherwise in window mode. A network that recalls the window which ended one frame
before gets each window frame by frame, so that it recalls what it was trained on: in one call it would get
the window of T frames ago. Its result for a window is the last call's output. A network without a window is a
stream in both modes; so is, to rounding, one that makes each frame from the window that ends with it, as its
authors evaluate it. A network that makes the windows of a clip together gets the whole clip
(`MotionModel.takes_whole_clip`), and can't be a stream.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

from memmlp.common.progress import progress_bar
from memmlp.evaluation import metrics
from memmlp.evaluation.ik import IK, NoIK
from memmlp.motion.body import N_JOINTS, POSITION, ROTATION, SPARSE_DIM
from memmlp.motion.dataset import MotionDataset
from memmlp.motion.geometry import sixd_to_matrix
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.motion_model import State


class Evaluable(Protocol):
    """What can be evaluated: a MotionModel, or anything else with these attributes and methods."""

    frames: int

    @property
    def normalizer(self) -> Normalizer:
        """The normalizer, which converts between the world and network space."""

    @property
    def shift(self) -> int:
        """How many frames before the newest one the recalled past ends; 0 for a network that recalls none."""

    @property
    def windowless(self) -> bool:
        """Whether the network has no window, so that it is a stream in both modes."""

    @property
    def takes_whole_clip(self) -> bool:
        """Whether window mode passes a whole clip to `whole`, which makes all its windows together."""

    def initial_state(self, batch: int = 1) -> State:
        """Return the state of a fresh start."""

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        """Map new inputs (B, n, 54) to motion in the world, and the new state.

        The motion (B, newest, 198) is that of the newest frames; by default that of all frames that the
        network predicts.
        """

    def whole(self, sparse: Tensor) -> Tensor:
        """Map the inputs (N, 54) of a whole clip, N >= T, to its motion (N, 198) in the world."""


def stream(network: Evaluable, clips: Sequence[Tensor]) -> list[Tensor]:
    """Predict the world motion (N, 198) of clips (N, 252), frame by frame."""
    return frame_by_frame(network, clips, 1)


def window(network: Evaluable, clips: Sequence[Tensor]) -> list[Tensor]:
    """Predict the world motion (N, 198) of clips (N, 252), by non-overlapping windows."""
    if network.windowless:
        return stream(network, clips)
    if network.takes_whole_clip:
        return clip_by_clip(network, clips)
    if 0 < network.shift < network.frames:
        return frame_by_frame(network, clips, network.frames)
    return window_by_window(network, clips)


@torch.no_grad()
def frame_by_frame(network: Evaluable, clips: Sequence[Tensor], size: int) -> list[Tensor]:
    """Predict the motion (N, 198) of clips (N, 252) by calls of one new frame each.

    The motion of each window of `size` frames (or fewer at a clip's end) comes from the call that took in the
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
        motion[:active, since : t + 1] = output[:, since - t - 1 :]  # overwrites what earlier calls made
    return [motion[order.index(i), : len(clip)] for i, clip in enumerate(clips)]


@torch.no_grad()
def window_by_window(network: Evaluable, clips: Sequence[Tensor]) -> list[Tensor]:
    """Predict the motion (N, 198) of clips (N, 252) by calls of T new frames, or what is left of a clip."""
    size = network.frames
    order, lengths, inputs = _side_by_side(clips)
    motion = inputs.new_zeros(*inputs.shape[:2], POSITION.stop)
    state = network.initial_state(len(clips))
    for start in range(0, lengths[0], size):
        left = torch.tensor([min(size, length - start) for length in lengths if length > start])
        for new in left.unique().tolist():  # ascending: full windows, which alone go on, come last
            rows = (left == new).nonzero()[:, 0].to(inputs.device)
            own = {name: tensor[rows] for name, tensor in state.items()}
            output, after = network.advance(inputs[rows, start : start + new], own)
            motion[rows, start : start + new] = output[:, -new:]
        state = after
    return [motion[order.index(i), : len(clip)] for i, clip in enumerate(clips)]


@torch.no_grad()
def clip_by_clip(network: Evaluable, clips: Sequence[Tensor]) -> list[Tensor]:
    """Predict the motion (N, 198) of clips (N, 252), by one call for each whole clip."""
    inputs = [_at_least(clip[:, :SPARSE_DIM], network.frames) for clip in clips]
    motions = [network.whole(sparse) for sparse in progress_bar(inputs, "windows together", unit="clips")]
    return [motion[-len(clip) :] for motion, clip in zip(motions, clips, strict=True)]


MODE_FUNCTIONS: dict[str, Callable[[Evaluable, Sequence[Tensor]], list[Tensor]]] = {
    "window": window,
    "stream": stream,
}


def evaluate(
    network: Evaluable,
    dataset: MotionDataset,
    modes: Sequence[str],
    batch: int,
    ik: IK | None = None,
    own: metrics.UserMetrics | None = None,
) -> dict[str, Any]:
    """Compute the metrics of a dataset: `{"mean": {mode: {branch: {metric: value}}}, "clips": [...]}`.

    Each clip's metrics are means over its frames; the mean is the mean over clips.

    Args:
        network: the network to evaluate.
        dataset: the clips.
        modes: the evaluation modes.
        batch: the largest number of clips that are evaluated side by side.
        ik: inverse kinematics, whose result is one more branch.
        own: custom metrics.
    """
    clips = dataset.clips()
    rows: list[dict[str, Any]] = [
        {"name": name, "group": group, "frames": len(clip)}
        for name, group, clip in zip(dataset.names, dataset.groups, clips, strict=True)
    ]
    for row, source in zip(rows, dataset.sources or (), strict=False):
        row["source"] = source
    for mode in modes:
        motions = predict(network, clips, mode, batch)
        for row, clip, motion in zip(
            progress_bar(rows, "measuring", unit="clips"), clips, motions, strict=True
        ):
            row[mode] = clip_report(network.normalizer, motion, clip, ik, own)
    return {"mean": {mode: _mean([row[mode] for row in rows]) for mode in modes}, "clips": rows}


def predict(network: Evaluable, clips: Sequence[Tensor], mode: str, batch: int) -> list[Tensor]:
    """Predict the motion (N, 198) of each clip (N, 252), with at most `batch` clips side by side."""
    groups = [clips[i : i + batch] for i in range(0, len(clips), batch)]
    return [motion for group in groups for motion in MODE_FUNCTIONS[mode](network, group)]


def clip_report(
    normalizer: Normalizer,
    motion: Tensor,
    truth: Tensor,
    ik: IK | None = None,
    own: metrics.UserMetrics | None = None,
) -> dict[str, dict[str, float]]:
    """Return the metrics of both branches and of `ik`'s result, from motion (N, 198) and truth (N, 252)."""
    sparse, target = truth[:, :SPARSE_DIM], truth[:, SPARSE_DIM:]
    positions = joint_positions(motion), joint_positions(target)
    position = metrics.positions_report(*positions) | metrics.own_report(own or {}, "positions", *positions)
    report = {"rotation": rotations_report(normalizer, motion, truth, own), "position": position}
    solved = (ik or NoIK()).solutions(normalizer, motion, sparse)
    return report | {name: rotations_report(normalizer, one, truth, own) for name, one in solved.items()}


def rotations_report(
    normalizer: Normalizer, motion: Tensor, truth: Tensor, own: metrics.UserMetrics | None = None
) -> dict[str, float]:
    """Return the metrics of the rotations in motion (N, 198) against the truth (N, 252).

    Position metrics are included; these positions follow from the rotations by forward kinematics, with the
    head on its tracker.
    """
    sparse, target = truth[:, :SPARSE_DIM], truth[:, SPARSE_DIM:]
    rotations = local_rotations(motion), local_rotations(target)
    positions = normalizer.pose(motion, sparse), joint_positions(target)
    report = metrics.rotations_report(*rotations) | metrics.positions_report(*positions)
    report |= metrics.own_report(own or {}, "rotations", *rotations)
    return report | metrics.own_report(own or {}, "positions", *positions)


def local_rotations(motion: Tensor) -> Tensor:
    """Return the rotation matrices (N, 22, 3, 3) of motion (N, 198)."""
    return sixd_to_matrix(motion[:, ROTATION].unflatten(-1, (N_JOINTS, 6)))


def joint_positions(motion: Tensor) -> Tensor:
    """Return the position branch's joints (N, 22, 3) in motion (N, 198), metres, world."""
    return motion[:, POSITION].unflatten(-1, (N_JOINTS, 3))


def chunks(dataset: MotionDataset, length: int, least: int) -> list[Tensor]:
    """Cut a dataset's clips into pieces of `length` frames.

    Pieces of fewer than `least` frames are left out, unless all pieces are that short.
    """
    pieces = [piece for clip in dataset.clips() for piece in clip.split(length)]
    return [p for p in pieces if len(p) >= least] or pieces


@torch.no_grad()
def quick_stream(
    network: Evaluable, pieces: Sequence[Tensor], own: metrics.UserMetrics | None = None
) -> dict[str, float]:
    """Return the stream-mode metrics, averaged over pieces of clips, for validation during training."""
    motions = stream(network, pieces)
    pairs = zip(motions, pieces, strict=True)
    mean = _mean([clip_report(network.normalizer, motion, piece, own=own) for motion, piece in pairs])
    return {f"{branch} {name}": value for branch, values in mean.items() for name, value in values.items()}


def _side_by_side(clips: Sequence[Tensor]) -> tuple[list[int], list[int], Tensor]:
    """Return clips' order, the longest first, their lengths in it, and padded inputs (B, longest, 54)."""
    order = sorted(range(len(clips)), key=lambda i: -len(clips[i]))
    inputs = torch.nn.utils.rnn.pad_sequence([clips[i][:, :SPARSE_DIM] for i in order], batch_first=True)
    return order, [len(clips[i]) for i in order], inputs


def _at_least(sparse: Tensor, size: int) -> Tensor:
    """Pad inputs (N, 54) to at least `size` frames by repeating their first frame in front."""
    return torch.cat([sparse[:1].expand(max(size - len(sparse), 0), -1), sparse])


def _mean(rows: Sequence[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Return each branch's metrics, mean over clips; clips that are too short for a metric are left out.

    A clip for which the network returned NaN is not left out: all means of that branch are then NaN.
    """
    return {
        branch: {name: _mean_of([row[branch] for row in rows], name) for name in values}
        for branch, values in rows[0].items()
    }


def _mean_of(rows: Sequence[dict[str, float]], name: str) -> float:
    if any(math.isnan(row["MPJPE"]) for row in rows):  # which has a number on the shortest clip
        return math.nan
    return float(torch.tensor([row[name] for row in rows]).nanmean())
