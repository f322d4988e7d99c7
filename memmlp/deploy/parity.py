"""Parity: proof that an ONNX file computes what the network does, by streaming a whole clip through both."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn

from memmlp.common.progress import progress_bar
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.motion.body import ROTATION, SPARSE_DIM
from memmlp.motion.torch_threads import one_thread
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.own_past_memory import Blend
from memmlp.networks.vqvae import Codebook

TOLERANCE = 1e-4  # on 6D components and metres
ROUNDING = 10 * TOLERANCE  # the most that is put down to rounding; see `tolerated`
DRAWS = 4  # float32 computations whose errors tell how a frame is conditioned; see `each_within_rounding`
SPREAD = 4  # how far above the largest of these errors a difference may be
MARGIN = 60  # frames that are compared with a full past
TIE = 1e-4  # the margin below which rounding may choose another code-vector; see `Codebook.margins`


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
    """Return the longest clips (N, 252), each as far as it takes to see the network with a full past.

    On a short clip a graph that forgets its past, or never drops it, computes what the network does. They are
    at least as long as the first clip, where they can be.

    Args:
        model: the trained network.
        clips: test clips (N, 252).
        count: how many are wanted; 0 for all, whole.
    """
    if not count:
        return list(clips)
    enough = max(frames_of_full_past(model) + MARGIN, len(clips[0]))
    return [clip[:enough] for clip in sorted(clips, key=len, reverse=True)[:count]]


def frames_of_full_past(model: MotionModel) -> int:
    """Return the number of frames after which nothing of the fresh start is left in the network's past."""
    return model.past_frames + model.frames


def parity(model: MotionModel, path: Path, clip: Tensor) -> float:
    """Return the largest difference between torch and ONNX Runtime over a clip, each on its own history.

    Args:
        model: the trained network.
        path: the exported file.
        clip: the clip's frames (N, 252).
    """
    return float(differences(model, path, clip).max())


@torch.no_grad()
def differences(model: MotionModel, path: Path, clip: Tensor) -> Tensor:
    """Return each frame's largest difference (N,) between torch and ONNX Runtime over a clip (N, 252).

    The positions of a network without a position branch are compared with the positions that follow, in
    float64, from ONNX Runtime's rotations. Where 6D columns are almost parallel, which an untrained network
    produces now and then, a difference between rotations within float32's rounding would otherwise be
    amplified a hundredfold.
    """
    model, clip = model.cpu().eval(), clip.cpu()
    made, found = in_torch(model, clip), streamed(OnnxStream(path), clip)
    if "position" not in model.branches:
        exact = copy.deepcopy(model.normalizer).double()
        positions = exact.pose(found.double(), clip[:, :SPARSE_DIM].double())
        made = torch.cat([made[:, ROTATION], positions.flatten(1)], 1)
    return (made - found).abs().amax(1)


@torch.no_grad()
def tolerated(model: MotionModel, path: Path, clip: Tensor, apart: float) -> bool:
    """Return whether a difference between torch and ONNX Runtime over a clip (N, 252) is due to rounding.

    A difference of at most TOLERANCE always is. One of at most ROUNDING may be, where a rotation is
    ill-conditioned, such as that of a hip whose swivel about a straight leg is measured from an axis along
    the leg (MANIKIN), or where many steps follow each other (a diffusion): it is accepted if torch's own
    rotations in float32 differ from those in float64 by at least half as much, or by a SPREADth where the
    file's graph and the network are the same in float64. A larger one is accepted if every frame that
    differs is as ill-conditioned as that (`each_within_rounding`), or if rounding chose another code-vector
    (`begins_at_ties`).
    """
    if not apart > TOLERANCE:  # NaN is not
        return apart <= TOLERANCE
    model, clip = model.cpu().eval(), clip.cpu()
    if apart <= ROUNDING:
        exact = in_torch(copy.deepcopy(model).double(), clip.double())
        rounding = float((in_torch(model, clip) - exact)[:, ROTATION].abs().max())
        if apart <= 2 * rounding or (apart <= SPREAD * rounding and same_in_float64(path, clip, exact)):
            return True
    each = differences(model, path, clip)
    if each_within_rounding(model, clip, each):
        return True
    return bool(codebooks(model)) and begins_at_ties(model, clip, each)


def same_in_float64(path: Path, clip: Tensor, exact: Tensor) -> bool:
    """Return whether a file's graph makes the rotations of `exact` (N, 198) of a clip (N, 252) in float64."""
    from memmlp.deploy.float64_graph import in_float64  # imports onnx, and is seldom needed

    return bool((in_float64(path, clip) - exact)[:, ROTATION].abs().max() <= TOLERANCE)


@torch.no_grad()
def each_within_rounding(model: MotionModel, clip: Tensor, apart: Tensor) -> bool:
    """Return whether each difference (N,) over a clip (N, 252) is such as rounding makes in its frame.

    How far float32 is from float64 in a frame is found by DRAWS computations whose inputs are moved by a
    rounding each, so that everything after them is rounded otherwise. A frame that differs by more than
    TOLERANCE may differ by SPREAD times the largest of these errors, and by the size of a rotation's
    components at most; nine in ten frames must not differ.
    """
    differ = apart > TOLERANCE
    if not 0 < int(differ.sum()) <= len(apart) // 10 or float(apart.max()) > 1:
        return False
    exact = in_torch(copy.deepcopy(model).double(), clip.double())
    draw = torch.Generator().manual_seed(0)
    errors = torch.zeros(len(apart), dtype=exact.dtype)
    for _ in range(DRAWS):
        moved = clip * (1 + torch.finfo(clip.dtype).eps * torch.randint(-1, 2, clip.shape, generator=draw))
        errors = errors.maximum((in_torch(model, moved) - exact).abs().amax(1))
    return bool((apart <= SPREAD * errors)[differ].all())


@torch.no_grad()
def begins_at_ties(model: MotionModel, clip: Tensor, apart: Tensor | np.ndarray) -> bool:
    """Return whether differences (N,) over a clip (N, 252 or 54) come from ties between code-vectors.

    Where a latent is equally far from two code-vectors, rounding decides. Two programs then differ for as
    long as the frame is in the window, and agree again after it. So each frame that differs by more than
    TOLERANCE has to follow another such frame, or lie within a window after a tie, and most frames must not
    differ.
    """
    since_tie, explained = float("inf"), False
    for margin, one in zip(smallest_margins(model, clip), apart.tolist(), strict=True):
        since_tie = 0 if margin < TIE else since_tie + 1
        explained = one > TOLERANCE and (explained or since_tie < model.frames)
        if not (one <= TOLERANCE or explained):
            return False
    return int((apart > TOLERANCE).sum()) <= len(apart) // 2


def smallest_margins(model: MotionModel, clip: Tensor) -> list[float]:
    """Return the smallest margin of a latent (`Codebook.margins`) for each frame of inputs (N, 252 or 54)."""
    found: list[float] = []
    smallest = []

    def note(book: nn.Module, given: tuple[Tensor], _: object) -> None:
        found.append(float(cast(Codebook, book).margins(given[0]).min()))

    hooks = [book.register_forward_hook(note) for book in codebooks(model)]
    try:
        for _ in motions(model, clip):
            smallest.append(min(found, default=float("inf")))
            found.clear()
    finally:
        for hook in hooks:
            hook.remove()
    return smallest


def codebooks(model: MotionModel) -> list[Codebook]:
    """Return the codebooks that a network contains."""
    return [module for module in model.modules() if isinstance(module, Codebook)]


@torch.no_grad()
def in_torch(model: MotionModel, clip: Tensor) -> Tensor:
    """Return the world motion (N, 198) that torch's network streams for a clip's inputs (N, 252 or 54)."""
    return torch.stack(list(motions(model, clip)))


def motions(model: MotionModel, clip: Tensor) -> Iterator[Tensor]:
    """Yield the world motion (198,) that the network streams, for each frame of a clip (N, 252 or 54).

    One thread computes it: a frame is little work, which several threads do more slowly, and far more slowly
    on a busy machine.
    """
    state = model.initial_state(1)
    with deterministic(model), one_thread():
        for sparse in progress_bar(clip[:, None, None, :SPARSE_DIM], "check"):
            motion, state = model.advance(sparse, state)
            yield motion[0, -1]


def streamed(stream: OnnxStream, clip: Tensor) -> Tensor:
    """Return the world motion (N, 198) that a fresh ONNX stream makes of a clip's inputs (N, 252 or 54)."""
    stream.reset()
    outputs = [stream.step(sparse) for sparse in clip[:, None, :SPARSE_DIM].numpy()]
    return torch.tensor(np.stack([np.concatenate([r.ravel(), p.ravel()]) for r, p in outputs]))
