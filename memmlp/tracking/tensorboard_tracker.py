"""The tracker that writes TensorBoard's event files, without TensorBoard: by tensorboardX."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from memmlp.tracking.view import Facts, Point, SweepFacts


@dataclass(frozen=True)
class TensorBoard:
    """Shows runs as folders of event files below outputs/tensorboard, each written anew when it begins.

    Attributes:
        outputs: the outputs folder.
    """

    outputs: Path

    name = "tensorboard"

    @property
    def place(self) -> str:
        """The folder for `tensorboard --logdir`."""
        return str(self.outputs.absolute() / "tensorboard")

    def has(self, run_id: str) -> bool:
        """Return whether there is a folder of that run."""
        return any(self._folders(run_id[:8]))

    def begin(self, facts: Facts, points: Sequence[Point]) -> ShownInTensorBoard:
        """Write a run's event file from its beginning; an earlier one is removed."""
        for old in self._folders(facts.id[:8]):
            shutil.rmtree(old)
        shown = ShownInTensorBoard(_writer(Path(self.place) / file_name(facts.title)))
        shown.log(points)
        return shown

    def sweep(self, facts: SweepFacts) -> None:
        """Write a sweep's table as text and its aggregates as values."""
        folder = Path(self.place) / file_name(f"sweep {facts.name}")
        shutil.rmtree(folder, ignore_errors=True)
        writer = _writer(folder)
        for path in facts.files:
            if path.suffix == ".md":
                writer.add_text("table", path.read_text(encoding="utf-8"), 0)
        verdicts = "\n".join(f"| {key} | {verdict} |" for key, verdict in facts.verdicts.items())
        writer.add_text("verdicts", f"| comparison | verdict |\n|---|---|\n{verdicts}", 0)
        for key, value in facts.aggregates.items():
            writer.add_scalar(file_name(key), value, 0)
        writer.close()

    def _folders(self, word: str) -> list[Path]:
        return [path for path in Path(self.place).glob(f"* {word}") if path.is_dir()]


class ShownInTensorBoard:
    """A run whose event file is open."""

    def __init__(self, writer: Any):
        self.writer = writer

    def log(self, points: Sequence[Point]) -> None:
        """Write values, and hand them to the operating system."""
        for point in points:
            self.writer.add_scalar(point.key, point.value, point.step, point.time)
        self.writer.flush()

    def end(self, facts: Facts, results: Sequence[Point]) -> None:
        """Write the results, and as text how the run ended, what people said of it, and its config."""
        self.log(results)
        config = "\n".join(f"| {key} | {value} |" for key, value in facts.config.items())
        texts = {"status": facts.status, "reason": facts.reason, "note": facts.note}
        texts |= {"tags": ", ".join(facts.labels), "config": f"| key | value |\n|---|---|\n{config}"}
        for key, text in texts.items():
            if text:
                self.writer.add_text(key, text, 0)
        self.writer.flush()

    def leave(self) -> None:
        """Close the file."""
        self.writer.close()


def _writer(folder: Path) -> Any:
    from tensorboardX import SummaryWriter

    return SummaryWriter(str(folder), flush_secs=3600)  # it is flushed by hand


def file_name(title: str) -> str:
    """Return a title as the name of a folder, as TensorBoard shows it."""
    return re.sub(r"[^\w=.,·+() -]", "_", title)[:120]
