"""Which operators of an ONNX file a runtime does not publish (`memmlp export --operators-for`).

The lists are data of this package (memmlp/deploy/operators), each with the document that it was taken from.
The list of ONNX Runtime itself is read from the installed runtime.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import onnx
import onnxruntime
import yaml
from onnx import GraphProto, ModelProto, NodeProto, TensorProto, helper

from memmlp.common.errors import InputError

TARGETS: dict[str, tuple[str, ...]] = {
    "onnxruntime": ("onnxruntime",),
    "web": ("wasm", "webgpu", "webnn"),
    "wasm": ("wasm",),
    "webgpu": ("webgpu",),
    "webnn": ("webnn",),
    "unity": ("unity",),
    "tensorrt": ("tensorrt",),
    "coreml": ("coreml",),
    "qnn": ("qnn",),
}
"""The targets by name, each with the lists that are looked into."""

KERNELS = {
    "onnxruntime": "CPU kernels of the ONNX Runtime that is installed here",
    "wasm": "CPU kernels of the ONNX Runtime that is installed here, which ONNX Runtime Web compiles to "
    "WebAssembly (https://www.npmjs.com/package/onnxruntime-web)",
}
"""The lists that ONNX Runtime itself gives, and what they are."""


@dataclass(frozen=True)
class Rule:
    """What a list says of an operator.

    Attributes:
        versions: the supported versions of the operator, such as "7-12,13+"; empty for all.
        constant: the inputs, by index, that must be constants.
        rank: the largest rank of some inputs, by index.
        types: the number types that the first input may have; empty where the list does not say.
        not_on: parts of the target that lack the operator.
        note: a condition that is not checked.
    """

    versions: str = ""
    constant: tuple[int, ...] = ()
    rank: Mapping[int, int] = field(default_factory=dict)
    types: tuple[str, ...] = ()
    not_on: tuple[str, ...] = ()
    note: str = ""

    def has(self, version: int) -> bool:
        """Return whether a version of the operator is supported."""
        return not self.versions or any(_within(version, part) for part in self.versions.split(","))


@dataclass(frozen=True)
class Published:
    """The operators that a runtime publishes as its own.

    Attributes:
        title, version, address: title, version and address of the document.
        outside: what the runtime does with a file that has other operators.
        operators: the rule for each operator, by name; those of Microsoft's domain are "com.microsoft.NAME".
        dated, read: the date of the document, and the date on which it was read; empty where unknown.
        opsets: the first and the last opset; empty where the document does not say.
        folds: whether the runtime computes in advance what depends on constants alone.
        expands: whether the runtime expands operators that ONNX defines by other operators.
    """

    title: str
    version: str
    address: str
    outside: str
    operators: Mapping[str, Rule]
    dated: str = ""
    read: str = ""
    opsets: tuple[int, ...] = ()
    folds: bool = False
    expands: bool = False

    @property
    def source(self) -> str:
        """The document in words: its title, version and date, its address, and when it was read."""
        dated = f", {self.dated}" if self.dated else ""
        where = f" ({self.address}; read {self.read})" if self.address else ""
        return f"{self.title}, {self.version}{dated}{where}"


class UnsupportedOperator(NamedTuple):
    """An operator or opset of a graph that a list does not support.

    Attributes:
        what: the operator with its version, or the opset.
        nodes: the number of nodes that it concerns; 0 for the opset.
        why: what is wrong with it.
    """

    what: str
    nodes: int
    why: str


def published(name: str) -> Published:
    """Return a list by its name, one of those in TARGETS."""
    if name in KERNELS:
        return _kernels(KERNELS[name])
    text = resources.files("memmlp.deploy").joinpath("operators", f"{name}.yaml").read_text("utf-8")
    found: dict[str, Any] = yaml.safe_load(text)
    found |= {key: str(found[key]) for key in ("dated", "read") if key in found}
    found["opsets"] = tuple(found.get("opsets", ()))
    found["operators"] = {operator: _rule(said or {}) for operator, said in found["operators"].items()}
    return Published(**found)


def findings(model: ModelProto, listed: Published) -> list[UnsupportedOperator]:
    """Return a graph's operators that a list lacks, each once per reason, and its opset if it is outside."""
    opset = next((o.version for o in model.opset_import if o.domain in ("", "ai.onnx")), 0)
    outside = Counter[tuple[str, str]]()
    facts = _Facts(model, listed.folds)
    for node in facts.nodes:
        version = _version(node, opset)
        for why in _reasons(node, version, listed, facts):
            outside[f"{_name(node)} (version {version})", why] += 1
    found = [UnsupportedOperator(what, count, why) for (what, why), count in sorted(outside.items())]
    if listed.opsets and not listed.opsets[0] <= opset <= listed.opsets[1]:
        first, last = listed.opsets
        found.insert(0, UnsupportedOperator(f"opset {opset}", 0, f"published are {first} to {last}"))
    return found


def remarks(model: ModelProto, listed: Published) -> list[str]:
    """Return a list's remarks on the operators that a graph uses."""
    used = sorted({_name(node) for node in _nodes(model.graph)})
    rules = {name: listed.operators[name] for name in used if name in listed.operators}
    lacking = [f"{name}: not on {', '.join(rule.not_on)}" for name, rule in rules.items() if rule.not_on]
    return lacking + [f"{name}: {rule.note}" for name, rule in rules.items() if rule.note]


def load_graph(path: Path) -> ModelProto:
    """Read an ONNX file. Raises InputError for a missing or damaged file."""
    try:
        model = onnx.load(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; allowed is an ONNX file") from None
    except Exception:  # protobuf's own exceptions have no common base class
        raise InputError(f"{path}: no ONNX file; allowed is what memmlp export writes") from None
    if not model.graph.node:
        raise InputError(f"{path}: an ONNX file without a graph; allowed is what memmlp export writes")
    return model


class _Facts:
    """What the checks need to know of a graph: its nodes, constants, and its tensors' types and ranks."""

    def __init__(self, model: ModelProto, folds: bool):
        inferred = _inferred(model)
        self.constants = {tensor.name for tensor in inferred.initializer}
        self.types = {tensor.name: tensor.data_type for tensor in inferred.initializer}
        self.ranks = {tensor.name: len(tensor.dims) for tensor in inferred.initializer}
        for value in (*inferred.input, *inferred.output, *inferred.value_info):
            self.types[value.name] = value.type.tensor_type.elem_type
            self.ranks[value.name] = len(value.type.tensor_type.shape.dim)
        self.nodes = []
        for node in _nodes(inferred):
            folded = node.op_type == "Constant" or all(name in self.constants for name in node.input if name)
            if folded:
                self.constants.update(node.output)
            if not (folds and folded):
                self.nodes.append(node)


def _inferred(model: ModelProto) -> GraphProto:
    """Return a model's graph with the types and ranks of its tensors, as far as onnx can infer them."""
    try:
        return onnx.shape_inference.infer_shapes(model).graph
    except onnx.shape_inference.InferenceError:
        return model.graph


def _reasons(node: NodeProto, version: int, listed: Published, facts: _Facts) -> Iterator[str]:
    """Yield the reasons why a list does not support a node."""
    rule = listed.operators.get(_name(node))
    if rule is None:
        if not (listed.expands and _is_function(node, version)):
            yield "not in the list"
        return
    if not rule.has(version):
        yield f"the list has version {rule.versions}"
    given = {index: name for index, name in enumerate(node.input) if name}
    for index in rule.constant:
        if index in given and given[index] not in facts.constants:
            yield f"input {index} must be a constant"
    for index, rank in rule.rank.items():
        if index in given and facts.ranks.get(given[index], 0) > rank:
            yield f"input {index} must have at most {rank} dimensions"
    kind = _type(facts.types.get(given.get(0, ""), TensorProto.UNDEFINED))
    if rule.types and kind and kind not in rule.types:
        yield f"takes no {kind}"


def _nodes(graph: GraphProto) -> Iterator[NodeProto]:
    """Yield the nodes of a graph, including those of its subgraphs."""
    for node in graph.node:
        yield node
        for attribute in node.attribute:
            for inner in (attribute.g, *attribute.graphs):
                yield from _nodes(inner)


def _name(node: NodeProto) -> str:
    return node.op_type if node.domain in ("", "ai.onnx") else f"{node.domain}.{node.op_type}"


def _version(node: NodeProto, opset: int) -> int:
    """Return the opset that introduced the present form of an operator; 1 if onnx does not know it."""
    if node.domain in ("", "ai.onnx") and onnx.defs.has(node.op_type, opset):
        return onnx.defs.get_schema(node.op_type, opset).since_version
    return 1


def _is_function(node: NodeProto, version: int) -> bool:
    known: Any = onnx.defs.get_schema(node.op_type, version) if onnx.defs.has(node.op_type, version) else None
    return known is not None and (known.has_function or known.has_context_dependent_function)


def _type(kind: int) -> str:
    """Return the name of a number type; empty if the type is unknown."""
    return "" if kind == TensorProto.UNDEFINED else str(helper.tensor_dtype_to_np_dtype(kind))


def _within(version: int, part: str) -> bool:
    """Return whether a version is within a range such as "7", "7-12" or "13+"."""
    first, _, last = part.partition("-")
    if first.endswith("+"):
        return version >= int(first[:-1])
    return int(first) <= version <= int(last or first)


def _rule(said: Mapping[str, Any]) -> Rule:
    given: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in said.items()}
    return Rule(**given)


def _kernels(title: str) -> Published:
    """Return the operators for which the installed ONNX Runtime has kernels on a CPU."""
    from onnxruntime.capi import onnxruntime_pybind11_state as state

    ranges: dict[str, set[str]] = {}
    for kernel in state.get_all_opkernel_def():
        if kernel.provider == "CPUExecutionProvider":
            name = kernel.op_name if kernel.domain in ("", "ai.onnx") else f"{kernel.domain}.{kernel.op_name}"
            first, last = kernel.version_range
            open_ended = last >= 2**31 - 1
            ranges.setdefault(name, set()).add(f"{first}+" if open_ended else f"{first}-{last}")
    return Published(
        title=title,
        version=f"onnxruntime {onnxruntime.__version__}",
        address="",
        outside="no session opens",
        operators={name: Rule(",".join(sorted(versions))) for name, versions in ranges.items()},
        folds=True,
        expands=True,
    )
