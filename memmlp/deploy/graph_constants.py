"""The constants of an ONNX graph."""

from __future__ import annotations

import numpy as np
from onnx import GraphProto, numpy_helper


class Constants:
    """The constants of a graph; new ones can be added."""

    def __init__(self, graph: GraphProto):
        self.graph = graph
        self.known = {tensor.name: tensor for tensor in graph.initializer}

    def __contains__(self, name: str) -> bool:
        """Return whether a constant has that name."""
        return name in self.known

    def value(self, name: str) -> np.ndarray:
        """Return the value of a constant."""
        return numpy_helper.to_array(self.known[name])

    def add(self, name: str, value: np.ndarray) -> str:
        """Add a constant, unless there is one of that name, and return its name."""
        if name not in self.known:
            self.graph.initializer.append(numpy_helper.from_array(value, name))
            self.known[name] = self.graph.initializer[-1]
        return name

    def remove_unused(self) -> None:
        """Remove the constants that no node uses any more."""
        used = {name for node in self.graph.node for name in node.input}
        used |= {output.name for output in self.graph.output}
        kept = [tensor for tensor in self.graph.initializer if tensor.name in used]
        del self.graph.initializer[:]
        self.graph.initializer.extend(kept)
