"""An exported step computed in float64: what its graph computes, but for the rounding of its operations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from onnx import TensorProto, helper, numpy_helper
from onnx.reference import ReferenceEvaluator
from torch import Tensor

from memmlp.deploy.onnx_stream import NEXT, STATE, Arrays
from memmlp.motion.body import SPARSE_DIM

FATAL = 4  # the severity of messages of ONNX Runtime that are shown


def in_float64(path: Path, clip: Tensor) -> Tensor:
    """Return the world motion (N, 198) that a file of scope `step` makes of a clip (N, 252 or 54) in float64.

    Constants that the export has folded keep the rounding with which it computed them.

    Args:
        path: the file, in float32.
        clip: the clip's frames, in the world.
    """
    graph = onnx.load(path)
    _widen(graph)
    given = {one.name: np.zeros(_shape(one)) for one in graph.graph.input}
    names = [one.name for one in graph.graph.output]
    run = _runner(graph, given)
    (sparse,) = (name for name in given if not name.startswith(STATE))
    motions = []
    for frame in clip[:, None, :SPARSE_DIM].double().numpy():
        made = dict(zip(names, run(given | {sparse: frame}), strict=True))
        given = {name: made.get(name + NEXT, array) for name, array in given.items()}
        motions.append([made[name].ravel() for name in names if not name.endswith(NEXT)])
    return torch.tensor(np.stack([np.concatenate(parts) for parts in motions]))


def _runner(graph: onnx.ModelProto, given: Arrays) -> Callable[[Arrays], Sequence[np.ndarray]]:
    """Return what computes a graph's outputs: ONNX Runtime, or where it lacks an operator, ONNX' reference.

    Args:
        graph: the graph.
        given: any inputs, to try out.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = FATAL
    providers = ["CPUExecutionProvider"]
    try:
        session = onnxruntime.InferenceSession(graph.SerializeToString(), options, providers=providers)
        run = partial(session.run, None)
        run(given)
    except Exception:  # ONNX Runtime's own exceptions have no common base class
        run = partial(ReferenceEvaluator(graph).run, None)  # slower by an order of magnitude
    return run


def _shape(value: onnx.ValueInfoProto) -> tuple[int, ...]:
    return tuple(dimension.dim_value for dimension in value.type.tensor_type.shape.dim)


def _widen(model: onnx.ModelProto) -> None:
    """Make float64 of all that is float32 in a graph."""
    graph = model.graph
    constants = [
        attribute.t for node in graph.node for attribute in node.attribute if attribute.HasField("t")
    ]
    for tensor in (*graph.initializer, *constants):
        if tensor.data_type == TensorProto.FLOAT:
            wide = numpy_helper.to_array(tensor).astype(np.float64)
            tensor.CopyFrom(numpy_helper.from_array(wide, tensor.name))
    for node in graph.node:
        if node.op_type == "ConstantOfShape" and not node.attribute:  # which is float32's 0
            node.attribute.append(helper.make_attribute("value", numpy_helper.from_array(np.zeros(1))))
        for attribute in node.attribute:
            if node.op_type == "Cast" and attribute.name == "to" and attribute.i == TensorProto.FLOAT:
                attribute.i = TensorProto.DOUBLE
    for value in (*graph.input, *graph.output, *graph.value_info):
        if value.type.tensor_type.elem_type == TensorProto.FLOAT:
            value.type.tensor_type.elem_type = TensorProto.DOUBLE
