"""The logger that writes TensorBoard's event files; it needs tensorboardX, not TensorBoard."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from memmlp.experiment_tracking.logged_values import CurvePoint, RunFacts, SweepFacts

LONGEST = 120  # characters of a folder's name
OWN = len(" · 01234567")  # of these, what tells a run from all others


@dataclass(frozen=True)
class TensorBoard:
    """Shows runs as folders of event files below outputs/tensorboard, each written anew when its run begins.

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
        """Return whether there is a folder for that run."""
        return any(self._folders(run_id[:8]))

    def begin(self, facts: RunFacts, points: Sequence[CurvePoint]) -> ShownInTensorBoard:
        """Write a run's event file from its beginning; an earlier file is removed."""
        for old in self._folders(facts.id[:8]):
            shutil.rmtree(old)
        shown = ShownInTensorBoard(EventFile(Path(self.place) / file_name(facts.title)))
        shown.log(points)
        return shown

    def sweep(self, facts: SweepFacts) -> None:
        """Write a sweep's status and table as text and its aggregates as values."""
        folder = Path(self.place) / file_name(f"sweep {facts.name}")
        shutil.rmtree(folder, ignore_errors=True)
        writer = EventFile(folder)
        writer.text("status", facts.status)
        for path in facts.files:
            if path.suffix == ".md":
                writer.text("table", path.read_text(encoding="utf-8"))
        verdicts = "\n".join(f"| {key} | {verdict} |" for key, verdict in facts.verdicts.items())
        writer.text("verdicts", f"| comparison | verdict |\n|---|---|\n{verdicts}")
        for key, value in facts.aggregates.items():
            writer.scalar(key, value, 0, 0.0)
        writer.close()

    def _folders(self, word: str) -> list[Path]:
        return [path for path in Path(self.place).glob(f"* {word}") if path.is_dir()]


class ShownInTensorBoard:
    """A run with an open event file."""

    def __init__(self, writer: EventFile):
        self.writer = writer

    def log(self, points: Sequence[CurvePoint]) -> None:
        """Write values to disk."""
        for point in points:
            self.writer.scalar(point.key, point.value, point.step, point.time)
        self.writer.flush()

    def end(self, facts: RunFacts, results: Sequence[CurvePoint]) -> None:
        """Write the results, and as text the run's status, its tags and note, and its config."""
        self.log(results)
        config = "\n".join(f"| {key} | {value} |" for key, value in facts.config.items())
        texts = {"status": facts.status, "reason": facts.reason, "note": facts.note}
        texts |= {"results by an earlier recipe": facts.earlier}
        texts |= {"tags": ", ".join(facts.tags), "config": f"| key | value |\n|---|---|\n{config}"}
        for key, text in texts.items():
            if text:
                self.writer.text(key, text)
        self.writer.flush()

    def leave(self) -> None:
        """Close the file."""
        self.writer.close()


class EventFile:
    """An event file that is written immediately; tensorboardX's SummaryWriter uses another thread."""

    def __init__(self, folder: Path):
        from tensorboardX.event_file_writer import EventsWriter

        folder.mkdir(parents=True, exist_ok=True)
        self.file = EventsWriter(str(folder / "events"))

    def scalar(self, key: str, value: float, step: int, time: float) -> None:
        """Add a value of a curve."""
        from tensorboardX.summary import scalar

        self._add(scalar(key, value), step, time)

    def text(self, key: str, text: str) -> None:
        """Add a text, in Markdown."""
        from tensorboardX.summary import text as summary

        self._add(summary(key, text), 0, 0.0)

    def flush(self) -> None:
        """Write what was added to disk."""
        self.file.flush()

    def close(self) -> None:
        """Close the file."""
        self.file.close()

    def _add(self, summary: Any, step: int, time: float) -> None:
        from tensorboardX.proto.event_pb2 import Event

        self.file.write_event(Event(summary=summary, step=step, wall_time=time))


def file_name(title: str) -> str:
    """Return a title as the name of a folder, shown by TensorBoard; a long one is cut before the run's id."""
    name = re.sub(r"[^\w=.,·+() -]", "_", title)
    return name if len(name) <= LONGEST else name[: LONGEST - OWN] + name[-OWN:]
