"""How a trained network is deployed: its live step as ONNX, checked and timed, and int8 or fp16 if asked."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from memmlp.common.progress import tell
from memmlp.deploy import latency
from memmlp.deploy.block_quantization import quantise_blocks
from memmlp.deploy.half_precision import halve
from memmlp.deploy.network_alone import network_alone
from memmlp.deploy.opsets import NATIVE
from memmlp.deploy.parity import TOLERANCE, clips_to_check, frames_of_full_past, parity, tolerated
from memmlp.deploy.precision_cost import compared
from memmlp.deploy.quantization import quantise
from memmlp.networks.motion_model import MotionModel, StreamingGraph
from memmlp.networks.streaming import has_stream, streaming
from memmlp.runs.deployment_folder import DeploymentFolder

GRAPHS: dict[str, Callable[[MotionModel], MotionModel | StreamingGraph]] = {
    "naive": lambda model: model,
    "streaming": streaming,
    "auto": lambda model: streaming(model) if has_stream(model) else model,
}
"""What is exported of a network. `streaming` computes each frame's own share once, `naive` is the network as
it was trained, and `auto` is `streaming` where there is such a graph."""


@dataclass(frozen=True)
class Deployment:
    """How networks are deployed.

    Attributes:
        latency_steps: number of timed steps, after a warm-up.
        graph: "auto", "streaming" or "naive" (see GRAPHS).
        precision: "fp32" for the float32 file alone; "int8", "int8_blocks" or "fp16" for a second file in
            that precision.
        opset: the files' ONNX opset, one of memmlp.deploy.opsets.OPSETS.
        alone: whether the network is also timed alone, without conversions and forward kinematics.
    """

    latency_steps: int
    graph: str = "auto"
    precision: str = "fp32"
    opset: int = NATIVE
    alone: bool = False

    def deploy(
        self,
        model: MotionModel,
        deployed: DeploymentFolder,
        run_id: str,
        train: Sequence[Tensor],
        test: Sequence[Tensor],
    ) -> dict[str, Any]:
        """Write a run's ONNX files and check the float32 one against torch on the longest test clip.

        Args:
            model: the trained network.
            deployed: where the files go.
            run_id: the run's id, for the files' metadata.
            train: training clips (N, 252), to calibrate int8.
            test: test clips (N, 252), to check the file, and to measure what lower precision costs in
                accuracy.

        Returns:
            The files' sizes and times, and the accuracy of the file with lower precision.

        Raises:
            RuntimeError: if ONNX Runtime's numbers differ from torch's by more than rounding explains.
        """
        from memmlp.deploy.export import export  # slow to import, and few processes export

        deployed.folder.mkdir(parents=True, exist_ok=True)
        network = GRAPHS[self.graph](model)
        export(network, deployed.onnx, run_id, self.opset)
        (clip,) = clips_to_check(model, test)
        if len(clip) < frames_of_full_past(model):
            tell(f"export: the longest test clip has {len(clip)} frames, too few to compare with a full past")
        worst = parity(model, deployed.onnx, clip)
        if not tolerated(model, deployed.onnx, clip, worst):
            raise RuntimeError(
                f"{deployed.onnx}: ONNX Runtime differs from torch by {worst:.2e} (> {TOLERANCE:.0e}), "
                "which is more than rounding explains"
            )
        record = self.times(model, deployed.onnx) | latency.size(model, network, deployed.onnx)
        record |= {
            "graph": "streaming" if isinstance(network, StreamingGraph) else "naive",
            "onnx_parity": worst,
            "parity_frames": len(clip),
        }
        if self.precision != "fp32":
            if isinstance(network, StreamingGraph):
                record[self.precision] = self._less_precise(network, deployed, train, test)
            else:
                tell(f"export: no file in {self.precision}, as {type(model).__name__} has no streaming graph")
        return record

    def times(self, model: MotionModel, path: Path) -> dict[str, float]:
        """Time a step of a network's exported file, and of the network alone if that is asked for."""
        record = latency.measure_step(path, self.latency_steps)
        return record | self._alone(model) if self.alone else record

    def _alone(self, model: MotionModel) -> dict[str, float]:
        """Return the times of the network alone, from features to its own outputs; its file is deleted."""
        from memmlp.deploy.export import export

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "alone.onnx"
            export(network_alone(model), path, "", self.opset)
            times = latency.measure_step(path, self.latency_steps)
        return {f"alone_{name}": value for name, value in times.items()}

    def _less_precise(
        self,
        network: StreamingGraph,
        deployed: DeploymentFolder,
        train: Sequence[Tensor],
        test: Sequence[Tensor],
    ) -> dict[str, Any]:
        """Write the file with lower precision beside the other; return its accuracy, times and size."""
        path = deployed.file(self.precision)
        lower(self.precision, deployed.onnx, path, network, train)
        cost = compared(deployed.onnx, path, self.precision, network.normalizer, test)
        measured = latency.measure_step(path, self.latency_steps)
        return {**cost, **measured, "onnx_bytes": path.stat().st_size}


def lower(precision: str, source: Path, path: Path, network: StreamingGraph, train: Sequence[Tensor]) -> None:
    """Write a file with lower precision.

    Args:
        precision: "int8", "int8_blocks" or "fp16".
        source: the float32 ONNX file of a streaming graph.
        path: the file to write.
        network: the graph, which says which of its modules stay in float32.
        train: training clips (N, 252), to calibrate int8.
    """
    if precision == "int8":
        quantise(source, path, network.float32_modules, train)
    elif precision == "int8_blocks":
        quantise_blocks(source, path, network.float32_modules)
    else:
        halve(source, path, network.float32_modules)
