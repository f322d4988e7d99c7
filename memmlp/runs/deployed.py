"""What a run was shipped as: the folder of a deployment."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from memmlp.common.files import file_digest, now, read_json, write_json
from memmlp.runs.environment import environment
from memmlp.runs.identity import belongs, deployment_name


class Deployed:
    """What a run was shipped as: a folder runs/<id>/deployments/<identity>/.

    Attributes:
        onnx, int8, latency: its files; the last one is written last, and says what was measured.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.onnx = folder / "step.onnx"
        self.int8 = folder / "step.int8.onnx"
        self.latency = folder / "latency.json"

    @property
    def done(self) -> bool:
        """Whether all of it is there, and of the run below which it lies."""
        record = self.record
        whole = all((self.folder / name).is_file() for name in record.get("artifacts", {}))
        return bool(record) and whole and belongs(record.get("run"), self.folder.parent.parent)

    @property
    def current(self) -> bool:
        """Whether it was made by today's recipes."""
        return self.folder.name == deployment_name(self.settings)

    def finish(self, record: Mapping[str, Any]) -> None:
        """Write what was measured, with the digests of the files: the sign that all of it is there."""
        artifacts = {path.name: file_digest(path) for path in (self.onnx, self.int8) if path.exists()}
        made = {"made": now(), "made_by": environment(), "artifacts": artifacts}
        write_json(self.latency, {**record, **made})

    @property
    def record(self) -> dict[str, Any]:
        """What was measured: sizes, times, int8's accuracy; empty where it was not shipped."""
        # Version 0.1 called the yardstick of times a reference.
        return {
            re.sub(r"(^|_)reference(_|$)", r"\1yardstick\2", k): v for k, v in read_json(self.latency).items()
        }

    @property
    def made(self) -> str:
        """When."""
        return str(self.record.get("made", ""))

    @property
    def settings(self) -> dict[str, Any]:
        """What was asked for."""
        return dict(self.record.get("settings", {}))

    @property
    def prefers_int8(self) -> bool:
        """Whether its int8 file is as accurate as the other one."""
        return self.int8.exists() and bool(self.record.get("int8", {}).get("default"))
