"""What a trained network is shipped as: its live step as ONNX, checked, timed, and in int8 where asked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from memmlp.deploy import latency
from memmlp.deploy.export import export
from memmlp.deploy.parity import TOLERANCE, parity
from memmlp.deploy.quantization import compared, quantise
from memmlp.networks.streaming import StreamingGraph, streaming
from memmlp.networks.window_model import WindowModel
from memmlp.runs.deployed import Deployed

GRAPHS: dict[str, Callable[[WindowModel], WindowModel | StreamingGraph]] = {
    "naive": lambda model: model,
    "streaming": streaming,
    "auto": lambda model: streaming(model) if model.settled else model,
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
        self,
        model: WindowModel,
        deployed: Deployed,
        run_id: str,
        train: Sequence[Tensor],
        test: Sequence[Tensor],
    ) -> dict[str, Any]:
        """Write a run's ONNX files, proved on the first test clip; their sizes, times and int8's accuracy.

        Args:
            deployed: where the files go. run_id: of the run, for their metadata. train, test: clips (N, 252).

        Raises:
            RuntimeError: where ONNX Runtime's numbers are not torch's.
        """
        deployed.folder.mkdir(parents=True, exist_ok=True)
        network = GRAPHS[self.graph](model)
        export(network, deployed.onnx, run_id)
        worst = parity(model, deployed.onnx, test[0])
        if not worst <= TOLERANCE:
            raise RuntimeError(
                f"{deployed.onnx}: ONNX Runtime differs from torch by {worst:.2e} (> {TOLERANCE:.0e})"
            )
        record = latency.measure(deployed.onnx, self.latency_steps) | latency.size(
            model, network, deployed.onnx
        )
        record |= {
            "graph": "streaming" if isinstance(network, StreamingGraph) else "naive",
            "onnx_parity": worst,
        }
        if self.precision == "int8" and isinstance(network, StreamingGraph):
            record["int8"] = self._int8(network, deployed, train, test)
        return record

    def _int8(
        self, network: StreamingGraph, deployed: Deployed, train: Sequence[Tensor], test: Sequence[Tensor]
    ) -> dict[str, Any]:
        """Write the int8 file beside the float32 one: its accuracy, time and size."""
        quantise(deployed.onnx, deployed.int8, network.ends, train)
        cost = compared(deployed.onnx, deployed.int8, network.normalizer, test)
        measured = latency.measure(deployed.int8, self.latency_steps)
        return {**cost, **measured, "onnx_bytes": deployed.int8.stat().st_size}
