"""The folder of a deployment: a run's ONNX files and the measurements on them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from memmlp.common.files import file_digest, now, read_json, write_json
from memmlp.runs.environment import environment
from memmlp.runs.identity import belongs, deployment_id_of, deployment_versions

ONNX_FILES = {
    "fp32": "step.onnx",
    "int8": "step.int8.onnx",
    "int8_blocks": "step.int8_blocks.onnx",
    "fp16": "step.fp16.onnx",
}
"""The name of the ONNX file of each precision (`export.precision`)."""
INT8_PRECISIONS = ("int8", "int8_blocks")
"""The precisions that are used live where they are accurate enough: at the paper's sizes they are faster."""

MAX_GROWTH, MAX_JITTER_GROWTH = 0.01, 0.10
"""The largest relative growths of MPJPE and Jitter with which a lower precision may replace float32."""

LATENCY = "latency.json"
FILES = (LATENCY, *ONNX_FILES.values())
"""A deployment's files, in the order in which they are removed: the measurements first."""


class DeploymentFolder:
    """A deployment of a run: the folder runs/<id>/deployments/<identity>/.

    Attributes:
        folder: the folder.
        onnx: the float32 ONNX file.
        int8: the int8 ONNX file, if there is one.
        latency: the record of the measurements; it is written last.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.onnx = self.file("fp32")
        self.int8 = self.file("int8")
        self.latency = folder / LATENCY

    def file(self, precision: str) -> Path:
        """Return the ONNX file of a precision, one of ONNX_FILES, whether or not it was made."""
        return self.folder / ONNX_FILES[precision]

    @property
    def done(self) -> bool:
        """Whether the deployment is complete, and belongs to the run of its folder."""
        record = self.record
        whole = all((self.folder / name).is_file() for name in record.get("artifacts", {}))
        return bool(record) and whole and belongs(record.get("run"), self.folder.parent.parent)

    @property
    def current(self) -> bool:
        """Whether the deployment was made with the current component versions."""
        return self.folder.name == deployment_id_of(self.settings)

    @property
    def component_versions(self) -> dict[str, int]:
        """The component versions with which it was made; empty if these are not the current ones."""
        return deployment_versions(self.settings) if self.current else {}

    def finish(self, record: Mapping[str, Any]) -> None:
        """Write the measurements, with the files' digests; this marks the deployment as complete."""
        files = map(self.file, ONNX_FILES)
        artifacts = {path.name: file_digest(path) for path in files if path.exists()}
        write_json(self.latency, {**record, "made": now(), "made_by": environment(), "artifacts": artifacts})

    @property
    def record(self) -> dict[str, Any]:
        """The measurements: sizes, times, accuracy of lower precision; empty if there are none."""
        return read_json(self.latency)

    @property
    def made(self) -> str:
        """When the deployment was made, UTC in ISO 8601; empty if it was not."""
        return str(self.record.get("made", ""))

    @property
    def settings(self) -> dict[str, Any]:
        """The settings of the deployment, as they were asked for."""
        return dict(self.record.get("settings", {}))

    @property
    def accurate_int8(self) -> Path | None:
        """The int8 ONNX file, if there is one that is accurate enough to replace float32; else None."""
        record = self.record
        accurate = [name for name in INT8_PRECISIONS if accurate_enough(record.get(name, {}))]
        return next((self.file(name) for name in accurate if self.file(name).exists()), None)


def accurate_enough(cost: Mapping[str, Any]) -> bool:
    """Return whether a file of lower precision may replace float32, given the growth of its errors.

    Both growths have to be known: NaN, or a record without them, is not enough.
    """
    growth, jitter = (cost.get(name, math.inf) for name in ("growth", "jitter_growth"))
    return growth <= MAX_GROWTH and jitter <= MAX_JITTER_GROWTH


def deployed_precision(latency: Mapping[str, Any]) -> str:
    """Return the precision that was asked for in a deployment, if it has that file; else fp32."""
    precision = str((latency.get("settings") or {}).get("precision", "fp32"))
    return precision if precision in latency else "fp32"


def as_deployed(latency: Mapping[str, Any]) -> dict[str, Any]:
    """Return the measurements of a streaming step, with size and times of the file that was asked for."""
    return {**latency, **latency.get(deployed_precision(latency), {})}


def with_times_as_deployed(results: Mapping[str, Any]) -> dict[str, Any]:
    """Return a run's results, each deployment's with the numbers of the file that was asked for on top."""

    def merge(latency: Mapping[str, Any]) -> dict[str, Any]:
        deployed = as_deployed(latency)
        return {
            key: deployed[key] if isinstance(value, int | float) else value for key, value in latency.items()
        }

    return {
        name: merge(one) if name.startswith("latency") and isinstance(one, Mapping) else one
        for name, one in results.items()
    }


def timed_on(record: Mapping[str, Any]) -> str:
    """Return the processor and ONNX Runtime with which a deployment was measured; "?" if that is unknown."""
    made_by = record.get("made_by") or {}
    runtime = (made_by.get("packages") or {}).get("onnxruntime")
    if not made_by.get("cpu"):
        return "?"
    return f"{made_by['cpu']}, ONNX Runtime {runtime}" if runtime else str(made_by["cpu"])
