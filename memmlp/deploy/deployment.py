"""Deployment of a trained network: export to ONNX, parity check, timing and lower precision."""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from memmlp.common.progress import announce
from memmlp.deploy import latency
from memmlp.deploy.lower_precision import compare_accuracy, write_lower_precision
from memmlp.deploy.opsets import NATIVE
from memmlp.deploy.parity import (
    TOLERANCE,
    are_rounding_errors,
    count_frames_until_past_is_full,
    measure_differences,
    select_parity_clip,
)
from memmlp.networks.motion_model import MotionModel, StreamingGraph
from memmlp.networks.streaming import has_streaming_graph, make_streaming_graph
from memmlp.runs.deployment_folder import DeploymentFolder

GRAPHS: dict[str, Callable[[MotionModel], MotionModel | StreamingGraph]] = {
    "naive": lambda model: model,
    "streaming": make_streaming_graph,
    "auto": lambda model: make_streaming_graph(model) if has_streaming_graph(model) else model,
}
"""The graphs that can be exported. `naive` is the network as it was trained. `streaming` computes the
features of each frame only once. `auto` is `streaming` if the network has a streaming graph, and `naive`
otherwise."""


@dataclass(frozen=True)
class Deployment:
    """The settings of a deployment: the number of steps to time, after a warm-up; the graph (a key of
    GRAPHS); the precision ("fp32", "int8" or "fp16"; others than fp32 add a second file); the ONNX opset (one
    of OPSETS); and whether to time the network also without conversions and forward kinematics."""

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
        """Write a run's ONNX files, and compare the float32 file with torch on the longest test clip. Return
        sizes and times of the files, and the accuracy of the file with lower precision. `train` clips (N,
        252) calibrate int8; `test` clips (N, 252) serve for the comparison and the accuracy. Raises
        RuntimeError if ONNX Runtime and torch differ by more than rounding errors."""
        from memmlp.deploy.export import export  # slow to import, and few processes export

        deployed.folder.mkdir(parents=True, exist_ok=True)
        network = GRAPHS[self.graph](model)
        export(network, deployed.onnx, run_id, self.opset)
        clip = select_parity_clip(model, test)
        if len(clip) < count_frames_until_past_is_full(model):
            short = f"the longest test clip has only {len(clip)} frames"
            announce(f"export: {short}; the comparison ends before the network's history is full")
        apart = measure_differences(model, deployed.onnx, clip)
        worst = float(apart.max())
        if not are_rounding_errors(apart):
            wrong = f"{deployed.onnx}: ONNX Runtime differs from torch by {worst:.2e}"
            raise RuntimeError(f"{wrong}; must be at most {TOLERANCE:.0e}, or rounding errors")
        record: dict[str, Any] = {
            **self.measure_times(model, deployed.onnx),
            **latency.measure_size(model, network, deployed.onnx),
            "graph": "streaming" if isinstance(network, StreamingGraph) else "naive",
            "onnx_parity": worst,
            "parity_frames": len(clip),
        }
        if isinstance(network, StreamingGraph) and self.precision != "fp32":
            path = deployed.onnx_path(self.precision)
            write_lower_precision(self.precision, deployed.onnx, path, network, train)
            cost = compare_accuracy(deployed.onnx, path, self.precision, network.normalizer, test)
            times = latency.measure_step_times(path, self.latency_steps)
            record[self.precision] = {**cost, **times, "onnx_bytes": path.stat().st_size}
        elif self.precision != "fp32":
            reason = f"{type(model).__name__} does not have a streaming graph"
            announce(f"export.precision={self.precision}: skipped; {reason}")
        return record

    def measure_times(self, model: MotionModel, path: Path) -> dict[str, float]:
        """Time a step of an exported file. If `alone` is set, also time the network without conversions."""
        from memmlp.deploy.export import export

        record = latency.measure_step_times(path, self.latency_steps)
        if self.alone:
            with tempfile.TemporaryDirectory() as folder:
                alone = Path(folder) / "alone.onnx"
                export(latency.strip_conversions(model), alone, "", self.opset)
                times = latency.measure_step_times(alone, self.latency_steps)
            record |= {f"alone_{name}": value for name, value in times.items()}
        return record
