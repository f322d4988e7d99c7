"""Writes runs as TensorBoard event files; this needs tensorboardX, but not TensorBoard."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from memmlp.common.components import component
from memmlp.common.errors import check_installed
from memmlp.common.settings import Settings
from memmlp.common.text_formats import escape_markdown, make_key
from memmlp.runs.loggers.logger import CurvePoint, RunFacts

MAX_BYTES = 255  # of a file system
MAX_NAME = 120  # maximum length of a folder name, characters
FINGERPRINT = "memmlp-fingerprint"


@component("loggers", "tensorboard", builds="TensorBoard")
@dataclass
class TensorBoardSettings(Settings):
    """Writes runs as event files to outputs/tensorboard (needs pip install 'memmlp[tensorboard]')."""


@dataclass(frozen=True)
class TensorBoard:
    """Writes each run as a folder of event files in outputs/tensorboard."""

    outputs: Path

    name = "tensorboard"

    def __post_init__(self) -> None:
        check_installed("tensorboardX", "tensorboard", "loggers=tensorboard")

    @property
    def place(self) -> str:
        return str(self.outputs.absolute() / "tensorboard")

    def fingerprint(self, run_id: str) -> str | None:
        """Return the fingerprint in a run's folder of event files; None if the run has not ended there."""
        files = (folder / FINGERPRINT for folder in self._find_folders(run_id))
        return next((file.read_text() for file in files if file.exists()), None)

    def begin(self, facts: RunFacts, points: Sequence[CurvePoint]) -> ShownInTensorBoard:
        """Start a new event file for a run, and remove older ones."""
        for old in self._find_folders(facts.id):
            shutil.rmtree(old)
        shown = ShownInTensorBoard(Path(self.place) / _make_folder_name(facts.name, facts.id))
        shown.log(points)
        return shown

    def _find_folders(self, run_id: str) -> Iterator[Path]:
        return Path(self.place).glob(f"* {run_id[:8]}")


class ShownInTensorBoard:
    """A run with an open event file."""

    def __init__(self, folder: Path):
        from tensorboardX import SummaryWriter

        # flush() alone is not enough, since the writer's thread has a queue; the default is 120 s
        self.folder, self.writer = folder, SummaryWriter(str(folder), flush_secs=1)

    def log(self, points: Sequence[CurvePoint]) -> None:
        for point in points:
            self.writer.add_scalar(
                make_key(point.key, r"a-zA-Z0-9_./-", 500), point.value, point.step, walltime=point.time
            )
        self.writer.flush()

    def end(self, facts: RunFacts) -> None:
        """Write the results; write status, tags, note and config as text."""
        pairs = [("key", "value"), ("---", "---"), *facts.config.items()]
        config = "\n".join(f"| {escape_markdown(key)} | {escape_markdown(value)} |" for key, value in pairs)
        texts = {**facts.texts, "tags": ", ".join(facts.tags), "note": facts.note, "config": config}
        for key, text in texts.items():
            self.writer.add_text(key, text)
        self.log(facts.results)
        (self.folder / FINGERPRINT).write_text(facts.fingerprint)

    def close(self) -> None:
        self.writer.close()


def _make_folder_name(name: str, run_id: str) -> str:
    ending = f" · {run_id[:8]}"
    safe = re.sub(r"[^\w=.,·+() -]", "_", name)[: MAX_NAME - len(ending)]
    return safe.encode()[: MAX_BYTES - len(ending.encode())].decode(errors="ignore") + ending
