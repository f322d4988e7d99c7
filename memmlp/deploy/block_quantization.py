"""int8 of an exported stream in blocks: 8-bit weights with a scale for every 32 inputs of an output.

The inputs of a product are rounded to eight bits while it is computed, with a scale for every 32 of them
(`MatMulNBits`, one of ONNX Runtime's own operators). So no calibration is needed, and a layer is one
operation instead of four. It is meant for networks without a window, whose products have one row; products
with a window's rows are slower than in float32. Rounding errors differ from frame to frame and show as
jitter, even with fine scales, so the graph says here, too, which modules stay in float32.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import ModelProto, NodeProto, helper

from memmlp.common.files import atomic_write
from memmlp.deploy.graph_constants import Constants
from memmlp.deploy.quantization import inner_layers

BLOCK = 32  # inputs of a product that share a scale; the least that all of ONNX Runtime's kernels know
LEVELS, ZERO = 127, 128  # a weight w is stored as the byte 128 + 127 w / (largest of its block)
DOMAIN = "com.microsoft"
INTEGER_ACCURACY = 4  # the operator's accuracy level at which it multiplies integers


def quantise_blocks(source: Path, path: Path, kept: Sequence[str]) -> None:
    """Write the block-quantised form of an exported stream.

    Args:
        source: the float32 ONNX file of a streaming graph.
        path: the file to write.
        kept: names of the graph's modules that stay in float32.
    """
    atomic_write(path, in_blocks(onnx.load(source), kept).SerializeToString())


def in_blocks(model: ModelProto, kept: Sequence[str]) -> ModelProto:
    """Return the graph with the weights of its inner layers stored in blocks; see `quantise_blocks`."""
    inner, graph = set(inner_layers(model, kept)), model.graph
    constants = Constants(graph)
    nodes = [_product(node, constants) if node.name in inner else node for node in graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
    constants.remove_unused()
    if all(one.domain != DOMAIN for one in model.opset_import):
        model.opset_import.append(helper.make_opsetid(DOMAIN, 1))
    return model


def _product(node: NodeProto, constants: Constants) -> NodeProto:
    """Return the product of a layer, which was a Gemm or MatMul, with its weight stored in blocks."""
    values, name, *bias = node.input
    weight = constants.value(name)
    transposed = any(one.name == "transB" and one.i for one in node.attribute)
    weight = weight if transposed else weight.T
    codes, scales = blocks(weight)
    stored = constants.add(f"{name}.blocks", codes), constants.add(f"{name}.scales", scales.reshape(-1))
    outputs, inputs = weight.shape
    return helper.make_node(
        "MatMulNBits",
        [values, *stored, *(["", "", *bias] if bias else [])],
        list(node.output),
        node.name,
        domain=DOMAIN,
        N=outputs,
        K=inputs,
        bits=8,
        block_size=BLOCK,
        accuracy_level=INTEGER_ACCURACY,
    )


def blocks(weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a weight (outputs, inputs) as bytes (outputs, blocks, 32) and scales (outputs, blocks).

    The last block is padded with zeros.
    """
    outputs, inputs = weight.shape
    padded = np.pad(weight, ((0, 0), (0, -inputs % BLOCK))).reshape(outputs, -1, BLOCK)
    scales = np.abs(padded).max(-1) / LEVELS
    steps = np.divide(padded, scales[..., None], where=scales[..., None] > 0, out=np.zeros_like(padded))
    return (np.rint(steps) + ZERO).astype(np.uint8), scales.astype(np.float32)
