"""Deployment of a trained network: its live step as ONNX, checked and timed, also in lower precision."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from memmlp.common.progress import announce
from memmlp.deploy import latency
from memmlp.deploy.lower_precision import compare_accuracy, lower
from memmlp.deploy.opsets import NATIVE
from memmlp.deploy.parity import TOLERANCE, clips_to_check, differences, frames_of_full_past, is_rounding
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
            announce(
                f"export: the longest test clip has {len(clip)} frames, too few to compare with a full past"
            )
        apart = differences(model, deployed.onnx, clip)
        worst = float(apart.max())
        if not is_rounding(apart):
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
        if isinstance(network, StreamingGraph) and self.precision != "fp32":
            path = deployed.onnx_path(self.precision)
            lower(self.precision, deployed.onnx, path, network, train)
            cost = compare_accuracy(deployed.onnx, path, self.precision, network.normalizer, test)
            times = latency.measure_step(path, self.latency_steps)
            record[self.precision] = {**cost, **times, "onnx_bytes": path.stat().st_size}
        elif self.precision != "fp32":
            announce(f"export: no file in {self.precision}; {type(model).__name__} has no streaming graph")
        return record

    def times(self, model: MotionModel, path: Path) -> dict[str, float]:
        """Time a step of a network's exported file, and of the network alone if that is requested."""
        from memmlp.deploy.export import export

        record = latency.measure_step(path, self.latency_steps)
        if self.alone:
            with tempfile.TemporaryDirectory() as folder:
                alone = Path(folder) / "alone.onnx"
                export(latency.strip_conversions(model), alone, "", self.opset)
                times = latency.measure_step(alone, self.latency_steps)
            record |= {f"alone_{name}": value for name, value in times.items()}
        return record
