"""fp16 of an exported stream: its inner layers have 16-bit weights, which halves the file's size.

As under autocast, the products of these layers have 16-bit inputs and outputs, and everything between them
stays float32: sums, normalisations, the modules at the network's ends (`StreamingGraph.float32_modules`),
inputs, outputs and states. A world position of 4 m has a resolution of 4 mm in sixteen bits, and a state that
adds up small steps stops changing where the steps fall below its resolution. ONNX Runtime's converter is not
used, since it rounds every value between two nodes that are to stay float32.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import ModelProto, NodeProto, TensorProto, helper

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write
from memmlp.deploy.graph_constants import Constants
from memmlp.deploy.quantization import inner_layers

LARGEST = float(np.finfo(np.float16).max)
CAST = ".cast"  # how the names of the casts around products end


def halve(source: Path, path: Path, kept: Sequence[str]) -> None:
    """Write the fp16 form of an exported stream.

    Args:
        source: the float32 ONNX file of a streaming graph.
        path: the file to write.
        kept: names of the graph's modules that stay in float32.

    Raises:
        InputError: for a weight that sixteen bits cannot hold.
    """
    atomic_write(path, halved(onnx.load(source), kept).SerializeToString())


def halved(model: ModelProto, kept: Sequence[str]) -> ModelProto:
    """Return the graph with its inner layers' products in fp16; see `halve`."""
    inner, graph = set(inner_layers(model, kept)), model.graph
    constants, nodes, cast = Constants(graph), list[NodeProto](), dict[str, str]()
    for node in graph.node:
        if node.name not in inner:
            nodes.append(node)
            continue
        for index, name in enumerate(node.input):
            if name in constants:
                node.input[index] = constants.add(f"{name}.half", _half(name, constants.value(name)))
            else:
                if name not in cast:
                    cast[name] = f"{name}.half"
                    nodes.append(_cast(name, cast[name], TensorProto.FLOAT16))
                node.input[index] = cast[name]
        output = node.output[0]
        node.output[0] = f"{output}.made"
        nodes += [node, _cast(node.output[0], output, TensorProto.FLOAT)]
    del graph.node[:]
    graph.node.extend(nodes)
    del graph.value_info[:]
    constants.remove_unused()
    return model


def rounded(model: ModelProto) -> ModelProto:
    """Return a graph in fp16 that a CPU rounds where a GPU does: at the inputs and outputs of its products.

    ONNX Runtime's CPU provider has no product in fp16. It computes in float32, and leaves out casts to fp16
    and back, so that nothing but the weights would be rounded, and nothing could overflow. Here a maximum of
    the value with itself, which it does have in fp16, stands behind each cast to fp16, and before each cast
    from it. Sums within a product are float32's, as a GPU's tensor cores make them.
    """
    nodes = list[NodeProto]()
    for node in model.graph.node:
        if node.op_type != "Cast" or not node.name.endswith(CAST):
            nodes.append(node)
        elif onnx.helper.get_node_attr_value(node, "to") == TensorProto.FLOAT16:
            output, node.output[0] = node.output[0], f"{node.output[0]}.unrounded"
            nodes += [node, helper.make_node("Max", [node.output[0]] * 2, [output])]
        else:
            value, node.input[0] = node.input[0], f"{node.input[0]}.rounded"
            nodes += [helper.make_node("Max", [value] * 2, [node.input[0]]), node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    return model


def _cast(name: str, output: str, kind: int) -> NodeProto:
    return helper.make_node("Cast", [name], [output], f"{output}{CAST}", to=kind)


def _half(name: str, weight: np.ndarray) -> np.ndarray:
    """Return a weight in sixteen bits.

    Raises:
        InputError: if the weight exceeds the range of sixteen bits.
    """
    if not np.abs(weight).max() <= LARGEST:
        raise InputError(f"{name}: has weights beyond {LARGEST:.0f}; allowed is fp32")
    return weight.astype(np.float16)
