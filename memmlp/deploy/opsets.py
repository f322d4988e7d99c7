"""Conversion of exported graphs to other ONNX operator sets (opsets). Older engines need older opsets.

torch's exporter writes opset 18. The onnx package converts to newer opsets, but cannot convert the operators
of these graphs to older opsets. So this module rewrites the operators that differ in the older opset. It
rejects a graph with an operator that it cannot rewrite.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import onnx
from onnx import GraphProto, ModelProto, NodeProto, helper, numpy_helper, version_converter

from memmlp.common.errors import InputError

NATIVE = 18  # the opset that torch's exporter writes
OPSETS = range(15, 27)  # the supported opsets; ONNX Runtime 1.31 does not read newer opsets
WIDENED = ("Identity", "LeakyRelu", "Where")  # newer versions only support more number types


class GraphConstants:
    """The constants of a graph."""

    def __init__(self, graph: GraphProto):
        self.graph = graph
        self.known = {tensor.name: tensor for tensor in graph.initializer}

    def __contains__(self, name: str) -> bool:
        return name in self.known

    def get_value(self, name: str) -> np.ndarray:
        return numpy_helper.to_array(self.known[name])

    def add(self, name: str, value: np.ndarray) -> str:
        """Add a constant unless the name exists, and return the name."""
        if name not in self.known:
            self.graph.initializer.append(numpy_helper.from_array(value, name))
            self.known[name] = self.graph.initializer[-1]
        return name

    def replace_nodes(self, nodes: list[NodeProto]) -> None:
        """Replace all nodes of the graph, and remove unused constants."""
        del self.graph.node[:]
        self.graph.node.extend(nodes)
        used = {name for node in nodes for name in node.input}
        used |= {output.name for output in self.graph.output}
        kept = [tensor for tensor in self.graph.initializer if tensor.name in used]
        del self.graph.initializer[:]
        self.graph.initializer.extend(kept)


def convert_opset(model: ModelProto, opset: int) -> ModelProto:
    """Convert a graph from opset 18 to another opset. The results of the graph stay the same. Raises
    InputError if the opset is not in OPSETS, is unknown to the installed onnx package, or does not support
    the graph."""
    newest = min(OPSETS[-1], onnx.defs.onnx_opset_version())
    if not OPSETS[0] <= opset <= newest:
        raise InputError(f"opset={opset}: must be {OPSETS[0]} to {newest}")
    if opset > NATIVE:
        model = version_converter.convert_version(model, opset)
        model.ir_version = max(model.ir_version, helper.find_min_ir_version_for(model.opset_import))
    if opset >= NATIVE:
        return model
    lowered = ModelProto()
    lowered.CopyFrom(model)
    constants = GraphConstants(lowered.graph)
    constants.replace_nodes(
        [node for old in model.graph.node for node in _rewrite_node(old, opset, constants)]
    )
    del lowered.opset_import[:]
    lowered.opset_import.append(helper.make_opsetid("", opset))
    lowered.ir_version = helper.find_min_ir_version_for(lowered.opset_import)
    return lowered


def _rewrite_node(node: NodeProto, opset: int, constants: GraphConstants) -> Iterator[NodeProto]:
    """Yield the nodes in an older opset that replace a node of opset 18."""
    kind, attributes = node.op_type, {a.name: helper.get_attribute_value(a) for a in node.attribute}
    if kind in WIDENED or _find_version(kind, opset) == _find_version(kind, NATIVE):
        yield node
    elif kind.startswith("Reduce"):  # the axes were an attribute
        keep, axes = attributes.get("keepdims", 1), constants.get_value(node.input[1]).tolist()
        yield helper.make_node(kind, node.input[:1], node.output, node.name, axes=axes, keepdims=keep)
    elif kind == "Split":  # without sizes, all parts are equal; older opsets have no number of parts
        yield helper.make_node(kind, node.input, node.output, node.name, axis=attributes.get("axis", 0))
    elif kind == "Pad":  # it did not have axes
        assert len(node.input) <= 3 or not node.input[3]
        yield node
    elif kind == "LayerNormalization":
        yield from _write_out_normalization(node, attributes, constants)
    else:
        raise InputError(f"opset={opset}: must be {NATIVE}; this graph needs a newer form of {kind}")


def _find_version(kind: str, opset: int) -> int:
    """Return the version of an operator in an opset; 0 if the opset does not have the operator."""
    return onnx.defs.get_schema(kind, opset).since_version if onnx.defs.has(kind, opset) else 0


def _write_out_normalization(
    node: NodeProto, attributes: dict[str, Any], constants: GraphConstants
) -> Iterator[NodeProto]:
    """Yield the operators that replace a LayerNormalization before opset 17. Runtimes can fuse them."""
    axes = list(range(attributes.get("axis", -1), 0))
    assert axes
    name, x = node.output[0], node.input[0]
    epsilon = constants.add(f"{name}.epsilon", np.array(attributes.get("epsilon", 1e-5), np.float32))
    two = constants.add(f"{name}.two", np.array(2, np.float32))
    scaled = name if len(node.input) == 2 else f"{name}.scaled"

    def step(kind: str, inputs: list[str], output: str, **settings: Any) -> NodeProto:
        return helper.make_node(kind, inputs, [output], output, **settings)

    yield step("ReduceMean", [x], f"{name}.mean", axes=axes)
    yield step("Sub", [x, f"{name}.mean"], f"{name}.centred")
    yield step("Pow", [f"{name}.centred", two], f"{name}.squares")
    yield step("ReduceMean", [f"{name}.squares"], f"{name}.variance", axes=axes)
    yield step("Add", [f"{name}.variance", epsilon], f"{name}.safe")
    yield step("Sqrt", [f"{name}.safe"], f"{name}.deviation")
    yield step("Div", [f"{name}.centred", f"{name}.deviation"], f"{name}.normal")
    yield step("Mul", [f"{name}.normal", node.input[1]], scaled)
    if scaled != name:
        yield step("Add", [scaled, node.input[2]], name)
