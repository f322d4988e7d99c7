"""Parity: proof that an ONNX file computes what the network does, by streaming a whole clip through both."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from memmlp.common.progress import progress_bar
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.motion.body import ROTATION, SPARSE_DIM
from memmlp.motion.threads import one_thread
from memmlp.networks.memory import Blend
from memmlp.networks.motion_model import MotionModel

TOLERANCE = 1e-4  # on 6D components and metres
ROUNDING = 10 * TOLERANCE  # the most that is put down to rounding; see `tolerated`


@contextmanager
def deterministic(model: nn.Module) -> Iterator[None]:
    """Replace a sampled m (reading 7) by its mean, since torch and ONNX Runtime could not share draws."""
    sampled = [module for module in model.modules() if isinstance(module, Blend) and module.sampled]
    values = [blend.value for blend in sampled]
    try:
        for blend in sampled:
            blend.value = Blend.MEAN
        yield
    finally:
        for blend, value in zip(sampled, values, strict=True):
            blend.value = value


@torch.no_grad()
def parity(model: MotionModel, path: Path, clip: Tensor) -> float:
    """Return the largest difference between torch and ONNX Runtime, each on its own history, over a clip.

    The positions of a network without a position branch are compared with those that follow, in float64, from
    ONNX Runtime's rotations. Where 6D columns are almost parallel, which an untrained network produces now
    and then, a difference between rotations within float32's rounding would otherwise come out a hundredfold.

    Args:
        model: the trained network.
        path: the exported file.
        clip: (N, 252).
    """
    model, clip = model.cpu().eval(), clip.cpu()
    made, found = in_torch(model, clip), streamed(OnnxStream(path), clip)
    if "position" not in model.branches:
        exact = copy.deepcopy(model.normalizer).double()
        positions = exact.pose(found.double(), clip[:, :SPARSE_DIM].double())
        made = torch.cat([made[:, ROTATION], positions.flatten(1)], 1)
    return float((made - found).abs().max())


@torch.no_grad()
def tolerated(model: MotionModel, clip: Tensor, apart: float) -> bool:
    """Return whether a difference between torch and ONNX Runtime over a clip (N, 252) is rounding.

    Up to TOLERANCE it is. Up to ROUNDING it may be, where a rotation is ill-conditioned, as that of a hip is
    whose swivel is counted about a straight leg from an axis along it (MANIKIN): then torch's own rotations
    in float32 differ from those in float64 by half as much or more.
    """
    if not TOLERANCE < apart <= ROUNDING:
        return apart <= TOLERANCE
    model, clip = model.cpu().eval(), clip.cpu()
    exact = in_torch(copy.deepcopy(model).double(), clip.double())
    rounding = (in_torch(model, clip) - exact)[:, ROTATION].abs().max()
    return apart <= 2 * float(rounding)


@torch.no_grad()
def in_torch(model: MotionModel, clip: Tensor) -> Tensor:
    """Return the world motion (N, 198) that the network streams of a clip's inputs (N, 252 or 54).

    By one thread: a frame is little work, which several do more slowly, by far where the machine is busy.
    """
    state, made = model.initial_state(1), []
    with deterministic(model), one_thread():
        for sparse in progress_bar(clip[:, None, None, :SPARSE_DIM], "check"):
            motion, state = model.advance(sparse, state)
            made.append(motion[0, -1])
    return torch.stack(made)


def streamed(stream: OnnxStream, clip: Tensor) -> Tensor:
    """Return the world motion (N, 198) that a fresh ONNX stream makes of a clip's inputs (N, 252 or 54)."""
    stream.reset()
    outputs = [stream.step(sparse) for sparse in clip[:, None, :SPARSE_DIM].numpy()]
    return torch.tensor(np.stack([np.concatenate([r.ravel(), p.ravel()]) for r, p in outputs]))
