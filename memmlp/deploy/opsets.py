"""Conversion of exported graphs to other operator sets: older ones for older engines, newer ones on demand.

torch's exporter writes opset 18. Newer sets are made by onnx's own converter. That converter cannot go down
for the operators that these graphs have, so this module does it: the few operators with another form in the
older opset are rewritten, and a graph with any other operator that differs is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import onnx
from onnx import ModelProto, NodeProto, helper, version_converter

from memmlp.common.errors import InputError
from memmlp.deploy.graph_constants import Constants

NATIVE = 18
"""The opset that torch's exporter writes."""

OPSETS = range(15, 27)
"""The opsets that a graph can be brought to; ONNX Runtime 1.31 reads no newer one."""

WIDENED = ("Identity", "LeakyRelu", "Where")
"""Operators whose newer versions only take more types of numbers."""


def converted(model: ModelProto, opset: int) -> ModelProto:
    """Return a graph of opset 18 in another opset; it computes the same.

    Raises:
        InputError: for an opset that is not one of OPSETS, or that the installed onnx does not know.
    """
    newest = min(OPSETS[-1], onnx.defs.onnx_opset_version())
    if not OPSETS[0] <= opset <= newest:
        raise InputError(f"opset {opset}: allowed is {OPSETS[0]} to {newest}")
    if opset < NATIVE:
        return _lowered(model, opset)
    if opset > NATIVE:
        model = version_converter.convert_version(model, opset)
        needed = helper.find_min_ir_version_for(model.opset_import)
        model.ir_version = max(model.ir_version, needed)
    return model


def _lowered(model: ModelProto, opset: int) -> ModelProto:
    """Return a graph of opset 18 in an older opset."""
    made = ModelProto()
    made.CopyFrom(model)
    graph, constants = made.graph, Constants(made.graph)
    nodes = [node for old in model.graph.node for node in _rewritten(old, opset, constants)]
    del graph.node[:]
    graph.node.extend(nodes)
    del made.opset_import[:]
    made.opset_import.append(helper.make_opsetid("", opset))
    made.ir_version = helper.find_min_ir_version_for(made.opset_import)
    constants.remove_unused()
    return made


Rewriting = Callable[[NodeProto, Constants], Iterator[NodeProto]]


def _rewritten(node: NodeProto, opset: int, constants: Constants) -> Iterator[NodeProto]:
    """Yield the nodes by which an older opset expresses a node of opset 18."""
    kind = node.op_type
    if kind in WIDENED or _since(kind, opset) == _since(kind, NATIVE):
        yield node
    elif kind.startswith("Reduce"):
        yield from _reduced(node, constants)
    elif kind in REWRITINGS:
        yield from REWRITINGS[kind](node, constants)
    else:
        raise InputError(f"opset {opset}: has another {kind}, which this graph needs; allowed is {NATIVE}")


def _since(kind: str, opset: int) -> int:
    """Return the opset that introduced an operator's form in a given opset; 0 if it has no such operator."""
    if not onnx.defs.has(kind, opset):
        return 0
    return onnx.defs.get_schema(kind, opset).since_version


def _attributes(node: NodeProto) -> dict[str, Any]:
    return {attribute.name: helper.get_attribute_value(attribute) for attribute in node.attribute}


def _reduced(node: NodeProto, constants: Constants) -> Iterator[NodeProto]:
    """Yield a reduction as before opset 18: its axes are an attribute."""
    keep = _attributes(node).get("keepdims", 1)
    axes = constants.value(node.input[1]).tolist()
    yield helper.make_node(node.op_type, node.input[:1], node.output, node.name, axes=axes, keepdims=keep)


def _split(node: NodeProto, constants: Constants) -> Iterator[NodeProto]:
    """Yield a split as before opset 18: without sizes the parts are equal, and their number is not given."""
    yield helper.make_node("Split", node.input, node.output, node.name, axis=_attributes(node).get("axis", 0))


def _padded(node: NodeProto, constants: Constants) -> Iterator[NodeProto]:
    """Yield a padding as before opset 18, where it has no axes; the node stays as it is."""
    assert len(node.input) <= 3 or not node.input[3]
    yield node


def _normalised(node: NodeProto, constants: Constants) -> Iterator[NodeProto]:
    """Yield a LayerNormalization as before opset 17: written out, in a form that runtimes fuse again."""
    attributes = _attributes(node)
    assert attributes.get("axis", -1) == -1
    name, x = node.output[0], node.input[0]
    epsilon = constants.add(f"{name}.epsilon", np.array(attributes.get("epsilon", 1e-5), np.float32))
    two = constants.add(f"{name}.two", np.array(2, np.float32))
    scaled = name if len(node.input) == 2 else f"{name}.scaled"

    def step(kind: str, inputs: list[str], output: str, **settings: Any) -> NodeProto:
        return helper.make_node(kind, inputs, [output], output, **settings)

    yield step("ReduceMean", [x], f"{name}.mean", axes=[-1])
    yield step("Sub", [x, f"{name}.mean"], f"{name}.centred")
    yield step("Pow", [f"{name}.centred", two], f"{name}.squares")
    yield step("ReduceMean", [f"{name}.squares"], f"{name}.variance", axes=[-1])
    yield step("Add", [f"{name}.variance", epsilon], f"{name}.safe")
    yield step("Sqrt", [f"{name}.safe"], f"{name}.deviation")
    yield step("Div", [f"{name}.centred", f"{name}.deviation"], f"{name}.normal")
    yield step("Mul", [f"{name}.normal", node.input[1]], scaled)
    if scaled != name:
        yield step("Add", [scaled, node.input[2]], name)


REWRITINGS: dict[str, Rewriting] = {
    "Split": _split,
    "Pad": _padded,
    "LayerNormalization": _normalised,
}
