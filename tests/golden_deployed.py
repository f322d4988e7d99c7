"""Numbers of exported streams, for tests/golden.py."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import tiny
from golden_numbers import Numbers, summary

from memmlp.deploy import latency
from memmlp.deploy.export import export
from memmlp.deploy.lower_precision import lower
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.deploy.parity import streamed
from memmlp.networks.streaming import streaming

GRAPHS: dict[str, Callable] = {"graph.streaming": streaming, "graph.naive": lambda network: network}


def deployed(graph: str) -> Numbers:
    """An exported stream on a clip, and what its sizes are."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "step.onnx"
        path.write_bytes(exported(graph))
        motion = streamed(OnnxStream(path), tiny.clip(25))
    return summary("motion", motion) | {"macs": float(latency.macs(GRAPHS[graph](tiny.model())))}


@cache
def exported(graph: str) -> bytes:
    """The ONNX file of a graph of the first tiny network."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "step.onnx"
        export(GRAPHS[graph](tiny.model()), path, "0" * 16)
        return path.read_bytes()


def lowered(precision: str) -> Numbers:
    """An exported stream in less precision."""
    with tempfile.TemporaryDirectory() as folder:
        exact, other = (Path(folder) / f"{name}.onnx" for name in ("exact", "other"))
        exact.write_bytes(exported("graph.streaming"))
        lower(precision, exact, other, streaming(tiny.model()), [tiny.clip(40)])
        return summary("motion", streamed(OnnxStream(other), tiny.clip(25)))
