"""Parity check: stream the same clip through an ONNX file and torch, and compare the results."""

import copy
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from memmlp.common.progress import progress_bar
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.motion.body import ROTATION, SPARSE_DIM
from memmlp.motion.geometry import limit_to_one_thread
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.own_past_memory import Blend

TOLERANCE = 1e-4  # for 6D components and metres
ROUNDING = 10 * TOLERANCE  # the largest median difference from rounding; see `are_rounding_errors`
MARGIN = 60  # number of frames to compare after the network's history is full


@contextmanager
def disable_sampling(model: nn.Module) -> Iterator[None]:
    """Replace a sampled m by its mean (docs/readings.md, no. 7), because torch and ONNX Runtime cannot use
    the same random numbers."""
    sampled = [part for part in model.modules() if isinstance(part, Blend) and part.value == "sampled"]
    for blend in sampled:
        blend.value = Blend.MEAN
    try:
        yield
    finally:
        for blend in sampled:
            blend.value = "sampled"


def select_parity_clip(model: MotionModel, clips: Sequence[Tensor]) -> Tensor:
    """Return the longest of some test clips (N, 252), cut to the length that a parity check needs. It
    includes frames after the network's history is full, because errors in handling the history do not show
    before. It is at least the length of the first clip."""
    enough = max(count_frames_until_past_is_full(model) + MARGIN, len(clips[0]))
    return max(clips, key=len)[:enough]


def count_frames_until_past_is_full(model: MotionModel) -> int:
    """Return the number of frames after which the network's history contains only real frames."""
    return model.past_frames + model.frames


@torch.no_grad()
def measure_differences(model: MotionModel, path: Path, clip: Tensor) -> Tensor:
    """Return each frame's largest difference (N,) between torch and ONNX Runtime over a clip (N, 252). Each
    uses its own history. If the network does not have a position branch, the expected positions are computed
    in float64 from ONNX Runtime's rotations. Otherwise, forward kinematics would amplify rounding errors a
    hundredfold for 6D columns that are almost parallel. Untrained networks sometimes produce such columns."""
    model, clip = model.cpu().eval(), clip.cpu()
    expected, exported = stream_torch(model, clip), stream_onnx(OnnxStream(path), clip)
    if "position" not in model.branches:
        exact = copy.deepcopy(model.normalizer).double()
        positions = exact.compute_positions(exported.double(), clip[:, :SPARSE_DIM].double())
        expected = torch.cat([expected[:, ROTATION], positions.flatten(1)], 1)
    return (expected - exported).abs().amax(1)


def are_rounding_errors(apart: Tensor) -> bool:
    """Return whether the differences (N,) between torch and ONNX Runtime are rounding errors: all are at most
    TOLERANCE, or their median is at most ROUNDING. Some frames can differ more, because a rotation is
    ill-conditioned, such as the swivel of a straight leg; a network has many consecutive steps (a diffusion);
    or a latent has the same distance to two code-vectors, and rounding decides between them."""
    return bool(apart.max() <= TOLERANCE or apart.median() <= ROUNDING)


@torch.no_grad()
def stream_torch(model: MotionModel, clip: Tensor) -> Tensor:
    """Return the world motion (N, 198) of the torch network, streamed over a clip (N, 252 or 54)."""
    state, motions = model.initial_state(1), []
    with disable_sampling(model), limit_to_one_thread():
        for sparse in progress_bar(clip[:, None, None, :SPARSE_DIM], "check"):
            motion, state = model.advance(sparse, state)
            motions.append(motion[0, -1])
    return torch.stack(motions)


def stream_onnx(stream: OnnxStream, clip: Tensor) -> Tensor:
    """Reset an ONNX stream, and return its world motion (N, 198) for a clip (N, 252 or 54)."""
    stream.reset()
    outputs = [stream.step(sparse) for sparse in clip[:, None, :SPARSE_DIM].numpy()]
    return torch.tensor(np.stack([np.concatenate([r.ravel(), p.ravel()]) for r, p in outputs]))
