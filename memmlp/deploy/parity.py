"""Parity: proof that an ONNX file computes what the network does, by streaming a whole clip through both."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from memmlp.common.progress import progress_bar
from memmlp.deploy.onnx_stream import NEXT, Arrays, OnnxStream, start_session
from memmlp.motion.body import ROTATION, SPARSE_DIM
from memmlp.motion.geometry import one_thread
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.own_past_memory import Blend

TOLERANCE = 1e-4  # on 6D components and metres
ROUNDING = 10 * TOLERANCE  # the largest median difference that rounding explains; see `is_rounding`
MARGIN = 60  # frames that are compared with a full past
FATAL = 4  # the severity of messages of ONNX Runtime that are shown


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
    expected, found = in_torch(model, clip), streamed(OnnxStream(path), clip)
    if "position" not in model.branches:
        exact = copy.deepcopy(model.normalizer).double()
        positions = exact.pose(found.double(), clip[:, :SPARSE_DIM].double())
        expected = torch.cat([expected[:, ROTATION], positions.flatten(1)], 1)
    return (expected - found).abs().amax(1)


def matches(model: MotionModel, path: Path, clip: Tensor, apart: Tensor) -> bool:
    """Return whether `differences` (N,) over a clip (N, 252) are due to rounding; see `is_rounding`."""

    def exact() -> float:
        wide, frames = copy.deepcopy(model).cpu().double().eval(), clip.cpu().double()
        made = in_float64(path, {"sparse": frames[:, :SPARSE_DIM].numpy()})
        found = torch.cat([torch.from_numpy(part).flatten(1) for part in made.values()], 1)
        return float((in_torch(wide, frames) - found).abs().max())

    return is_rounding(apart, exact)


def is_rounding(apart: Tensor, exact: Callable[[], float]) -> bool:
    """Return whether each frame's differences (N,) between torch and ONNX Runtime are due to rounding.

    Differences of at most TOLERANCE are. Larger ones are if graph and network agree in float64 and most
    frames differ by at most ROUNDING in float32. A rotation can be ill-conditioned, such as a hip's swivel
    about a straight leg. Many steps can follow each other (a diffusion). A latent can be equally far from two
    code-vectors, so that rounding chooses.

    Args:
        apart: the differences in float32.
        exact: returns the largest difference in float64.
    """
    if apart.max() <= TOLERANCE:
        return True
    return bool(apart.median() <= ROUNDING) and exact() <= TOLERANCE


@torch.no_grad()
def in_torch(model: MotionModel, clip: Tensor) -> Tensor:
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


def streamed(stream: OnnxStream, clip: Tensor) -> Tensor:
    """Return the world motion (N, 198) that a fresh ONNX stream makes of a clip's inputs (N, 252 or 54)."""
    stream.reset()
    outputs = [stream.step(sparse) for sparse in clip[:, None, :SPARSE_DIM].numpy()]
    return torch.tensor(np.stack([np.concatenate([r.ravel(), p.ravel()]) for r, p in outputs]))


def in_float64(path: Path, inputs: Mapping[str, np.ndarray]) -> Arrays:
    """Stream inputs through a float32 file whose graph is widened to float64.

    Constants that the export has folded keep the rounding with which it computed them.

    Args:
        path: the exported file.
        inputs: the inputs by name, each (N, ...), one frame after the other.

    Returns:
        The outputs by name, each (N, ...), without states.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper
    from onnx.reference import ReferenceEvaluator

    model = onnx.load(path)
    graph = model.graph
    constants = [a.t for node in graph.node for a in node.attribute if a.HasField("t")]
    for tensor in (*graph.initializer, *constants):
        if tensor.data_type == TensorProto.FLOAT:
            wide = numpy_helper.to_array(tensor).astype(np.float64)
            tensor.CopyFrom(numpy_helper.from_array(wide, tensor.name))
    for node in graph.node:
        if node.op_type == "ConstantOfShape" and not node.attribute:  # whose default is float32's 0
            node.attribute.append(helper.make_attribute("value", numpy_helper.from_array(np.zeros(1))))
        for attribute in node.attribute:
            if node.op_type == "Cast" and attribute.name == "to" and attribute.i == TensorProto.FLOAT:
                attribute.i = TensorProto.DOUBLE
    for value in (*graph.input, *graph.output, *graph.value_info):
        if value.type.tensor_type.elem_type == TensorProto.FLOAT:
            value.type.tensor_type.elem_type = TensorProto.DOUBLE

    shapes = {i.name: [d.dim_value for d in i.type.tensor_type.shape.dim] for i in graph.input}
    names = [output.name for output in graph.output]
    given = {name: np.zeros(shape) for name, shape in shapes.items()}
    run: Callable[[Arrays], Any]
    try:
        run = partial(start_session(model.SerializeToString(), FATAL).run, None)
        run(given)
    except Exception:  # it lacks an operator in float64; its exceptions have no common base class
        run = partial(ReferenceEvaluator(model).run, None)  # slower by an order of magnitude
    made: dict[str, list[np.ndarray]] = {name: [] for name in names if not name.endswith(NEXT)}
    for index in range(len(next(iter(inputs.values())))):
        frame = {name: part[index].reshape(shapes[name]) for name, part in inputs.items()}
        outputs = dict(zip(names, run(given | frame), strict=True))
        given = {name: outputs.get(name + NEXT, array) for name, array in given.items()}
        for name, parts in made.items():
            parts.append(outputs[name])
    return {name: np.concatenate(parts) for name, parts in made.items()}
