"""What a trained network is shipped as: its live step as ONNX, checked, timed, and in int8 where asked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from memmlp import latency
from memmlp.export import export
from memmlp.model import WindowModel
from memmlp.parity import TOLERANCE, parity
from memmlp.quantization import compared, quantise
from memmlp.runs import Run
from memmlp.streaming import Stream, has_stream, streaming

GRAPHS: dict[str, Callable[[WindowModel], WindowModel | Stream]] = {
    "naive": lambda model: model,
    "streaming": streaming,
    "auto": lambda model: streaming(model) if has_stream(model) else model,
}
"""`streaming` computes each frame's own share once, `naive` is the network as it was trained, `auto` the
first of them that there is."""


@dataclass(frozen=True)
class Deployment:
    """How networks are shipped.

    Args:
        latency_steps: timed steps, after a warm-up.
        graph: "auto", "streaming" or "naive". precision: "fp32", or "int8" for a file beside it.
    """

    latency_steps: int
    graph: str = "auto"
    precision: str = "fp32"

    def ship(
        self, model: WindowModel, run: Run, train: Sequence[Tensor], test: Sequence[Tensor]
    ) -> dict[str, Any]:
        """Write a run's ONNX files, proved on the first test clip; their sizes, times and int8's accuracy.

        Args:
            train, test: clips (N, 252).
        """
        network = GRAPHS[self.graph](model)
        export(network, run.onnx, run.id)
        worst = parity(model, run.onnx, test[0])
        run.write_manifest({"onnx_parity": worst})
        if not worst <= TOLERANCE:
            raise RuntimeError(
                f"{run.onnx}: ONNX Runtime differs from torch by {worst:.2e} (> {TOLERANCE:.0e})"
            )
        record = latency.measure(run.onnx, self.latency_steps) | latency.size(model, network, run.onnx)
        record["graph"] = "streaming" if isinstance(network, Stream) else "naive"
        if self.precision == "int8" and isinstance(network, Stream):
            record["int8"] = self._int8(network, run.onnx, run.int8, train, test)
        return record

    def _int8(
        self, network: Stream, source: Path, path: Path, train: Sequence[Tensor], test: Sequence[Tensor]
    ) -> dict[str, Any]:
        """Write the int8 file beside the float32 one: its accuracy, time and size."""
        quantise(source, path, network.ends, train)
        cost = compared(source, path, network.frame, test)
        return {**cost, **latency.measure(path, self.latency_steps), "onnx_bytes": path.stat().st_size}
