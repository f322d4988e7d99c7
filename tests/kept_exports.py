"""What torch's exporter makes of modules that differ in their weights alone, made once in a run of the tests.

The exporter never looks at weights (it traces with tensors that have a shape and no numbers), and takes two
seconds to find the same graph of each tiny network again. So its graph is kept, below the folder that all
test processes share, by everything that it follows from; the weights are put into it anew each time, and
what memmlp itself does with a graph (folding constants, opsets, files) is done each time, too.
"""

from __future__ import annotations

import functools
import hashlib
import io
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import onnx
import onnx_ir
from filelock import FileLock
from torch import Tensor, nn


class Kept(NamedTuple):
    """What memmlp uses of an exporter's program."""

    model: onnx_ir.Model

    @property
    def model_proto(self) -> onnx.ModelProto:
        return onnx_ir.serde.serialize_model(self.model)


def kept(export: Callable[..., Any], folder: Path) -> Callable[..., Any]:
    """Return an exporter that keeps its graphs in a folder."""

    @functools.wraps(export)
    def exported(module: nn.Module, *arguments: Any, **options: Any) -> Any:
        key = _key(module, arguments, options)
        if key is None:
            return export(module, *arguments, **options)
        path = folder / f"{key}.onnx"
        with FileLock(f"{path}.lock"):
            if path.exists():
                return Kept(_filled(onnx.load(path), _weights(module)))
            program = export(module, *arguments, **options)
            if (graph := _emptied(program.model_proto, _weights(module))) is not None:
                unfinished = path.with_suffix(".unfinished")
                onnx.save(graph, unfinished)
                unfinished.replace(path)
        return program

    return exported


def _key(module: nn.Module, arguments: tuple[Any, ...], options: dict[str, Any]) -> str | None:
    """Return all that a graph follows from, as a digest; None where that is not known.

    That is the module with its settings, but of its weights the form alone, what it is exported with, and the
    code of memmlp. Code from elsewhere is not known.
    """
    packages = {type(part).__module__.split(".")[0] for part in module.modules()}
    if len(arguments) != 1 or not packages <= OWN:
        return None
    said = io.BytesIO()
    pickler = _Pickler(said, module)
    try:
        pickler.dump((module, arguments, sorted(options.items())))
    except (pickle.PicklingError, AttributeError, TypeError, RecursionError, ValueError):
        return None
    return hashlib.sha256(_sources() + said.getvalue()).hexdigest()


OWN = {"memmlp", "torch"}


class _Pickler(pickle.Pickler):
    """Writes of weights the form, and which are one tensor; nothing else depends on who shares an object."""

    def __init__(self, file: io.BytesIO, module: nn.Module):
        super().__init__(file, protocol=5)
        self.fast = True  # no references to equal objects written before
        self.weights = {id(tensor): i for i, tensor in enumerate(_weights(module).values())}

    def persistent_id(self, thing: Any) -> Any:
        if isinstance(thing, set | frozenset):
            return sorted(thing, key=repr)  # which a set is not, in each process otherwise
        if not isinstance(thing, Tensor):
            return None
        form = (tuple(thing.shape), thing.stride(), str(thing.dtype), str(thing.device), thing.requires_grad)
        if id(thing) in self.weights:
            return self.weights[id(thing)], form
        return thing.detach().contiguous().numpy().tobytes(), form


@functools.cache
def _sources() -> bytes:
    """Return a digest of memmlp's code."""
    import memmlp

    digest = hashlib.sha256()
    for path in sorted(Path(memmlp.__file__).parent.rglob("*.py")):
        digest.update(f"{path}\0".encode() + path.read_bytes())
    return digest.digest()


def _weights(module: nn.Module) -> dict[str, Tensor]:
    """Return a module's parameters and buffers, each by all of its names."""
    return {
        **dict(module.named_parameters(remove_duplicate=False)),
        **dict(module.named_buffers(remove_duplicate=False)),
    }


def _emptied(graph: onnx.ModelProto, weights: dict[str, Tensor]) -> onnx.ModelProto | None:
    """Take the weights out of a graph. None where one is not the module's as it is."""
    for tensor in graph.graph.initializer:
        if tensor.name in weights:
            if tensor.raw_data != _raw(weights[tensor.name]):
                return None
            tensor.raw_data = b""
    return graph


def _filled(graph: onnx.ModelProto, weights: dict[str, Tensor]) -> onnx_ir.Model:
    """Put the weights into a graph."""
    for tensor in graph.graph.initializer:
        if tensor.name in weights:
            tensor.raw_data = _raw(weights[tensor.name])
    return onnx_ir.serde.deserialize_model(graph)


def _raw(tensor: Tensor) -> bytes:
    return tensor.detach().contiguous().numpy().tobytes()
