"""Parity: proof that an ONNX file computes what the network does, by streaming a whole clip through both."""

from __future__ import annotations

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
from memmlp.motion.geometry import one_thread
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.own_past_memory import Blend

TOLERANCE = 1e-4  # on 6D components and metres
ROUNDING = 10 * TOLERANCE  # the largest median difference that rounding explains; see `is_rounding`
MARGIN = 60  # frames that are compared with a full past


@contextmanager
def deterministic(model: nn.Module) -> Iterator[None]:
    """Replace a sampled m (reading 7) by its mean, since torch and ONNX Runtime can't share random draws."""
    sampled = [module for module in model.modules() if isinstance(module, Blend) and module.sampled]
    values = [blend.value for blend in sampled]
    try:
        for blend in sampled:
            blend.value = Blend.MEAN
        yield
    finally:
        for blend, value in zip(sampled, values, strict=True):
            blend.value = value


def clips_to_check(model: MotionModel, clips: Sequence[Tensor], count: int = 1) -> list[Tensor]:
    """Return the longest clips (N, 252), each cut to a length that shows the network with a full past.

    On a short clip a graph that forgets its past, or never drops it, computes what the network does. They are
    at least as long as the first clip, where they can be.

    Args:
        model: the trained network.
        clips: test clips (N, 252).
        count: how many clips to return; 0 for all, whole.
    """
    if not count:
        return list(clips)
    enough = max(frames_of_full_past(model) + MARGIN, len(clips[0]))
    return [clip[:enough] for clip in sorted(clips, key=len, reverse=True)[:count]]


def frames_of_full_past(model: MotionModel) -> int:
    """Return the number of frames after which nothing of the fresh start is left in the network's past."""
    return model.past_frames + model.frames


def parity(model: MotionModel, path: Path, clip: Tensor) -> float:
    """Return the largest difference between torch and ONNX Runtime over a clip (N, 252)."""
    return float(differences(model, path, clip).max())


@torch.no_grad()
def differences(model: MotionModel, path: Path, clip: Tensor) -> Tensor:
    """Return each frame's largest difference (N,) between torch and ONNX Runtime over a clip (N, 252).

    Each has its own history. The positions of a network without a position branch are compared with the
    positions that follow, in float64, from ONNX Runtime's rotations. Where 6D columns are almost parallel,
    which an untrained network sometimes produces, forward kinematics would amplify rounding a hundredfold.
    """
    model, clip = model.cpu().eval(), clip.cpu()
    expected, found = stream_torch(model, clip), stream_onnx(OnnxStream(path), clip)
    if "position" not in model.branches:
        exact = copy.deepcopy(model.normalizer).double()
        positions = exact.pose(found.double(), clip[:, :SPARSE_DIM].double())
        expected = torch.cat([expected[:, ROTATION], positions.flatten(1)], 1)
    return (expected - found).abs().amax(1)


def is_rounding(apart: Tensor) -> bool:
    """Return whether each frame's differences (N,) between torch and ONNX Runtime are due to rounding.

    Differences of at most TOLERANCE are. Larger ones are, too, if half of the frames differ by at most
    ROUNDING. A rotation can be ill-conditioned, such as a hip's swivel about a straight leg. Many steps can
    follow each other (a diffusion). A latent can be equally far from two code-vectors, so that rounding
    chooses.
    """
    return bool(apart.max() <= TOLERANCE or apart.median() <= ROUNDING)


@torch.no_grad()
def stream_torch(model: MotionModel, clip: Tensor) -> Tensor:
    """Return the world motion (N, 198) that torch's network streams for a clip's inputs (N, 252 or 54).

    One thread computes it: a frame is little work, which several threads do more slowly, and far more slowly
    on a busy machine.
    """
    state, motions = model.initial_state(1), []
    with deterministic(model), one_thread():
        for sparse in progress_bar(clip[:, None, None, :SPARSE_DIM], "check"):
            motion, state = model.advance(sparse, state)
            motions.append(motion[0, -1])
    return torch.stack(motions)


def stream_onnx(stream: OnnxStream, clip: Tensor) -> Tensor:
    """Return the world motion (N, 198) that a fresh ONNX stream makes of a clip's inputs (N, 252 or 54)."""
    stream.reset()
    outputs = [stream.step(sparse) for sparse in clip[:, None, :SPARSE_DIM].numpy()]
    return torch.tensor(np.stack([np.concatenate([r.ravel(), p.ravel()]) for r, p in outputs]))
