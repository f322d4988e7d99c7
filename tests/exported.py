"""Tiny networks with a streaming step that several tests share."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import tiny

from memmlp.motion.network_coordinates import Heading
from memmlp.networks.memory import LSTMMemory, NoMemory
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.own_past_memory import CodeMemory

if TYPE_CHECKING:
    from onnx import GraphProto

BASELINES = [name for name in tiny.BASELINES if name not in ("agrol_mlp", "ego_poser", "manikin_l")]
"""Without those whose graphs are made of others' parts: an export of MANIKIN-L takes ten seconds."""
DIFFUSIONS = ("agrol_diffusion", "bodiffusion")
NETWORKS: dict[str, Callable[[], MotionModel]] = {
    "mem_mlp": partial(tiny.model, CodeMemory, coordinates=Heading()),
    "lstm": partial(tiny.model, LSTMMemory, coordinates=Heading()),
    "no_memory": partial(tiny.model, NoMemory),
    "recurrent_poser": partial(tiny.recurrent_poser, Heading(), width=40),
    "refined": lambda: tiny.refined(tiny.model(NoMemory, coordinates=Heading())),
    **{name: partial(tiny.baseline, name, depth=1) for name in BASELINES},
    **{name: partial(tiny.baseline, name, depth=1, sampling_steps=2) for name in DIFFUSIONS},
    "avatar_poser": partial(tiny.baseline, "avatar_poser", Heading(), depth=1),
}
"""Few are relative to the heading, which adds the same hundred nodes to each graph."""
NEEDED = ("mem_mlp", "no_memory", "recurrent_poser", "avatar_poser")  # by several tests


def write(name: str, path: Path, space: str | None = None) -> None:
    # Imported here, since they take seconds to import and most test files need neither.
    from memmlp.deploy.export import export
    from memmlp.live.trackers_to_body_graph import export_full
    from memmlp.networks.streaming import make_streaming_graph

    stream = make_streaming_graph(NETWORKS[name]())
    if space:
        export_full(stream, path, "0123456789abcdef", space)
    else:
        export(stream, path, "0123456789abcdef")


DATA_DEPENDENT = {
    "Compress", "Equal", "GatherND", "If", "Loop", "NonZero", "Or", "Range", "Scan", "ScatterElements",
    "ScatterND", "Shape", "Unique",
}  # fmt: skip
"""Operators with a shape or work that depends on the data, and those that lead to them."""

INDICES = {"Slice": 1, "Split": 1, "Reshape": 1, "Expand": 1, "Pad": 1, "Tile": 1}
"""The first input that must be constant, by operator. Tables may be read at any index."""


def data_dependent(graph: "GraphProto") -> set[str]:
    """The operators of a graph with a shape or work that depends on the data."""
    constants = {tensor.name for tensor in graph.initializer}
    found = set()
    for node in graph.node:
        computed = set(node.input[INDICES.get(node.op_type, len(node.input)) :]) - constants - {""}
        if node.op_type in DATA_DEPENDENT or computed:
            found.add(node.op_type)
    return found
