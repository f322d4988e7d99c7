"""ONNX files without weights; the page makes random ones, since values do not matter for a step's time."""

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
    """A tensor whose numbers the page makes at random.

    Attributes:
        offset: where the tensor begins among all drawn tensors of the graph, bytes.
        size: how many numbers the tensor has.
        kind: the numbers' type: float32, float16 or int8.
        scale: the numbers' standard deviation about 0, that of the weights which they replace.
    """

    offset: int
    size: int
    kind: str
    scale: float


def without_weights(model: onnx.ModelProto) -> list[Drawn]:
    """Remove the large weights from a graph, and return the tensors that are to be drawn in their place.

    Drawn numbers of about the same size keep the operations' speed: none becomes infinite, or so small that a
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
