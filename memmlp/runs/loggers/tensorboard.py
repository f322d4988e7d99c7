"""Writes runs as TensorBoard's event files; it needs tensorboardX, not TensorBoard."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from memmlp.common.components import component
from memmlp.common.errors import check_installed
from memmlp.common.settings import Settings
from memmlp.runs.loggers.logger import CurvePoint, RunFacts

MAX_NAME = 120  # characters of a folder's name
FINGERPRINT = "memmlp-fingerprint"


@component("loggers", "tensorboard", builds="TensorBoard")
@dataclass
class TensorBoardSettings(Settings):
    """Writes runs as event files below outputs/tensorboard (needs pip install 'memmlp[tensorboard]')."""


@dataclass(frozen=True)
class TensorBoard:
    """Shows runs as folders of event files below outputs/tensorboard, each replaced when its run begins.

    Attributes:
        outputs: the outputs folder.

    Raises:
        InputError: if tensorboardX is not installed.
    """

    outputs: Path

    name = "tensorboard"

    def __post_init__(self) -> None:
        check_installed("tensorboardX", "tensorboard", "loggers=tensorboard")

    @property
    def place(self) -> str:
        """The folder for `tensorboard --logdir`."""
        return str(self.outputs.absolute() / "tensorboard")

    def fingerprint(self, run_id: str) -> str | None:
        """Return the fingerprint of the facts with which a run's file ended; None if it did not."""
        files = (folder / FINGERPRINT for folder in self._folders(run_id))
        return next((file.read_text() for file in files if file.exists()), None)

    def begin(self, facts: RunFacts, points: Sequence[CurvePoint]) -> ShownInTensorBoard:
        """Write a run's event file from its beginning; an earlier file is removed."""
        for old in self._folders(facts.id):
            shutil.rmtree(old)
        shown = ShownInTensorBoard(Path(self.place) / _folder_name(facts.name, facts.id))
        shown.log(points)
        return shown

    def _folders(self, run_id: str) -> Iterator[Path]:
        return Path(self.place).glob(f"* {run_id[:8]}")


class ShownInTensorBoard:
    """A run with an open event file in a folder."""

    def __init__(self, folder: Path):
        from tensorboardX import SummaryWriter

        # flush() writes only what the writer's thread has already taken from its queue; 120 s is the default
        self.folder, self.writer = folder, SummaryWriter(str(folder), flush_secs=1)

    def log(self, points: Sequence[CurvePoint]) -> None:
        """Write values to disk."""
        for point in points:
            self.writer.add_scalar(point.key, point.value, point.step, walltime=point.time)
        self.writer.flush()

    def write_texts(self, texts: Mapping[str, str]) -> None:
        """Write texts, in Markdown."""
        for key, text in texts.items():
            self.writer.add_text(key, text)

    def end(self, facts: RunFacts) -> None:
        """Write the results, and as text the run's status, its tags and note, and its config."""
        config = _markdown("key", "value", facts.config)
        self.write_texts({**facts.texts, "tags": ", ".join(facts.tags), "note": facts.note, "config": config})
        self.log(facts.results)
        (self.folder / FINGERPRINT).write_text(facts.fingerprint)

    def close(self) -> None:
        """Close the file."""
        self.writer.close()


def _markdown(key: str, value: str, rows: Mapping[str, Any]) -> str:
    return "\n".join([f"| {key} | {value} |", "|---|---|", *(f"| {k} | {v} |" for k, v in rows.items())])


def _folder_name(name: str, run_id: str = "") -> str:
    """Return a name with the beginning of the run's id as the name of a folder, which TensorBoard shows."""
    ending = f" · {run_id[:8]}" if run_id else ""
    return re.sub(r"[^\w=.,·+() -]", "_", name)[: MAX_NAME - len(ending)] + ending
