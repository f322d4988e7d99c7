"""ONNX files without weights, which the page draws at random: they do not matter for a step's time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import onnx
from onnx import TensorProto, numpy_helper
from onnx.external_data_helper import set_external_data

LOCATION = "weights"  # the name by which the page hands them to ONNX Runtime
LEAST = 32_768  # bytes; smaller tensors, such as those of normalisation, and constants, stay in the file
ALIGNED = 64  # bytes
KINDS = {TensorProto.FLOAT: "float32", TensorProto.FLOAT16: "float16", TensorProto.INT8: "int8"}


class Drawn(NamedTuple):
    """A tensor that the page draws.

    Attributes:
        offset: where it begins among all of the graph's, bytes.
        size: how many numbers it has.
        kind: their type: float32, float16 or int8.
        scale: their standard deviation about 0, which is that of the weights they stand for.
    """

    offset: int
    size: int
    kind: str
    scale: float


def without_weights(model: onnx.ModelProto) -> list[Drawn]:
    """Take the large weights out of a graph, and return what is to be drawn in their place.

    Numbers of the same size go through the same operations: none becomes infinite, or so small that a
    processor takes longer over it.
    """
    drawn, end = [], 0
    for tensor in model.graph.initializer:
        kind, size = KINDS.get(tensor.data_type), len(tensor.raw_data)
        if kind is None or size < LEAST:
            continue
        values = numpy_helper.to_array(tensor)
        scale = float(np.sqrt(np.square(values.astype(np.float64)).mean()))
        if not np.isfinite(scale):  # a mask
            continue
        drawn.append(Drawn(end, values.size, kind, scale))
        set_external_data(tensor, LOCATION, end, size)
        tensor.ClearField("raw_data")
        end += -(-size // ALIGNED) * ALIGNED
    return drawn
