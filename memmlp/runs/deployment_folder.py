"""The folder of a deployment: a run's ONNX files and their measurements."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from memmlp.common.files import file_digest, now, to_number, write_json
from memmlp.common.settings import PRECISIONS
from memmlp.runs import records
from memmlp.runs.identity import belongs_to_folder, find_deployment_versions, hash_deployment_settings

ONNX_FILES = {name: "step.onnx" if name == "fp32" else f"step.{name}.onnx" for name in PRECISIONS}
"""The ONNX file names, by precision (`export.precision`)."""

MAX_GROWTH, MAX_JITTER_GROWTH = 0.01, 0.10
"""A lower precision may replace float32 if MPJPE and Jitter grow at most by these fractions."""

LATENCY = "latency.json"
FILES = (LATENCY, *ONNX_FILES.values())
"""A deployment's files in order of removal: the measurements first."""


class DeploymentFolder:
    """A deployment of a run: the folder runs/<id>/deployments/<identity>/. `latency` is written last."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.onnx = self.onnx_path("fp32")
        self.int8 = self.onnx_path("int8")
        self.latency = folder / LATENCY

    def onnx_path(self, precision: str) -> Path:
        """Return the path of the ONNX file for a precision (a key of ONNX_FILES); it may not exist."""
        return self.folder / ONNX_FILES[precision]

    @property
    def done(self) -> bool:
        """Whether the deployment is complete and belongs to the run in whose folder it is."""
        record = self.record
        whole = all((self.folder / name).is_file() for name in record.get("artifacts", {}))
        return bool(record) and whole and belongs_to_folder(record.get("run"), self.folder.parent.parent)

    @property
    def is_current(self) -> bool:
        """Whether the deployment was made with the current component versions."""
        return self.folder.name == hash_deployment_settings(self.settings)

    @property
    def component_versions(self) -> dict[str, int]:
        """The component versions of the deployment; empty if some of them are outdated."""
        return find_deployment_versions(self.settings) if self.is_current else {}

    def finish(self, record: Mapping[str, Any]) -> None:
        """Write the measurements and the files' digests; this marks the deployment as complete."""
        from memmlp.runs.environment import describe_environment  # slow to import

        files = map(self.onnx_path, ONNX_FILES)
        artifacts = {path.name: file_digest(path) for path in files if path.exists()}
        facts = {"made": now(), "made_by": describe_environment(), "artifacts": artifacts}
        write_json(self.latency, {**record, **facts})

    @property
    def record(self) -> dict[str, Any]:
        """The measurements (sizes, times, accuracy of lower precisions); empty before `finish`."""
        return records.read(self.latency, records.Deployment)

    @property
    def settings(self) -> dict[str, Any]:
        """The requested settings of the deployment; empty before `finish`."""
        return dict(self.record.get("settings", {}))

    @property
    def accurate_int8_file(self) -> Path | None:
        """An existing int8 ONNX file that is accurate enough to replace float32; None without one."""
        return self.int8 if is_accurate_enough(self.record.get("int8", {})) and self.int8.exists() else None


def is_accurate_enough(cost: Mapping[str, Any]) -> bool:
    """Return whether a lower precision can replace float32, given the relative growth of its errors."""
    growth, jitter = (to_number(cost.get(name, math.inf)) for name in ("growth", "jitter_growth"))
    return growth <= MAX_GROWTH and jitter <= MAX_JITTER_GROWTH


def find_deployed_precision(latency: Mapping[str, Any]) -> str:
    """Return the requested precision of a deployment if it was exported; otherwise "fp32"."""
    precision = str((latency.get("settings") or {}).get("precision", "fp32"))
    return precision if precision in latency else "fp32"


def select_deployed_measurements(latency: Mapping[str, Any]) -> dict[str, Any]:
    """Return a deployment's measurements, with size and times of the requested precision at the top level."""
    return {**latency, **latency.get(find_deployed_precision(latency), {})}


def replace_with_deployed_times(results: Mapping[str, Any]) -> dict[str, Any]:
    """Return a run's results with each deployment's numbers replaced by those of the requested precision."""
    replaced = dict(results)
    for name, latency in results.items():
        if name.startswith("latency") and isinstance(latency, Mapping):
            deployed = select_deployed_measurements(latency)
            numbers = {key for key, value in latency.items() if isinstance(value, int | float)}
            replaced[name] = {**latency, **{key: deployed[key] for key in numbers}}
    return replaced


def describe_timing_machine(record: Mapping[str, Any]) -> str:
    """Return the processor and ONNX Runtime version of a deployment's measurements; "?" if unknown."""
    made_by = record.get("made_by") or {}
    runtime = (made_by.get("packages") or {}).get("onnxruntime")
    cpu = made_by.get("cpu") or "?"
    return f"{cpu}, ONNX Runtime {runtime}" if runtime and cpu != "?" else cpu
