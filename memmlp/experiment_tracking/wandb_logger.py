"""The logger that writes W&B's offline runs, with W&B's own client; `wandb sync` uploads them."""

from __future__ import annotations

import hashlib
import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from memmlp.experiment_tracking.logged_values import CurvePoint, RunFacts, SweepFacts

OFFLINE = {"WANDB_MODE": "offline", "WANDB_SILENT": "true", "WANDB_ERROR_REPORTING": "false"}

AXES = {"train/*": "step", "val/*": "step", "system/*": "system/time"}  # what curves are drawn over


@dataclass(frozen=True)
class WandB:
    """Shows runs as W&B's offline runs below outputs/wandb, each written anew when its run begins.

    Attributes:
        project: the project to which `wandb sync` uploads them.
        outputs: the outputs folder.
    """

    project: str
    outputs: Path

    name = "wandb"

    @property
    def place(self) -> str:
        """The folder of the offline runs."""
        return str(self.outputs.absolute() / "wandb")

    def has(self, run_id: str) -> bool:
        """Return whether there is an offline run for that id."""
        return any(self._folders(run_id))

    def begin(self, facts: RunFacts, points: Sequence[CurvePoint]) -> ShownInWandB:
        """Write a run from its beginning; an earlier offline run of it is removed."""
        notes, config = (
            facts.note or None,
            {**facts.config, "run": {**facts.origin, "folder": str(facts.folder)}},
        )
        run = self._begun(facts.id, facts.name, facts.tags, notes, config)
        for curves, axis in AXES.items():
            run.define_metric(curves, step_metric=axis)
        shown = ShownInWandB(run)
        shown.log(points)
        return shown

    def sweep(self, facts: SweepFacts) -> None:
        """Write a sweep as a run of its own, with aggregates, verdicts and table."""
        own = hashlib.sha256(facts.name.encode()).hexdigest()[:16]
        run = self._begun(own, f"sweep {facts.name}", ("sweep",), None, {"arms": dict(facts.arms)})
        verdicts = {f"verdict/{key}": verdict for key, verdict in facts.verdicts.items()}
        run.summary.update({"status": facts.status, **facts.aggregates, **verdicts})
        for path in facts.files:
            run.save(str(path), base_path=str(facts.folder), policy="now")
        run.finish(exit_code=0 if facts.status == "done" else 1)

    def _begun(
        self, own: str, name: str, tags: Sequence[str], notes: str | None, config: dict[str, Any]
    ) -> Any:
        os.environ.update(OFFLINE)
        import wandb

        stamps = {old.name.split("-")[2] for old in self._folders(own)}
        for old in self._folders(own):
            shutil.rmtree(old)
        while time.strftime("%Y%m%d_%H%M%S") in stamps:  # a folder of the same name would stay empty
            time.sleep(0.05)
        Path(self.place).mkdir(parents=True, exist_ok=True)
        settings = wandb.Settings(
            console="off", silent=True, x_disable_stats=True, x_disable_meta=True,
            disable_git=True, disable_code=True, disable_job_creation=True,
        )  # fmt: skip
        return wandb.init(
            project=self.project, id=own, name=name, tags=list(tags), notes=notes, config=config,
            dir=str(self.outputs.absolute()), mode="offline", settings=settings, reinit="create_new",
        )  # fmt: skip

    def _folders(self, own: str) -> list[Path]:
        return list(Path(self.place).glob(f"offline-run-*-{own}"))


class ShownInWandB:
    """A run that W&B's client has open.

    The values of one training step, or of one sample of the machine, are a row of W&B's history. Row numbers
    can only increase, so they equal the training steps until rows of the machine come between; each row
    contains its own step or time (`AXES`).
    """

    def __init__(self, run: Any):
        self.run, self.row = run, -1

    def log(self, points: Sequence[CurvePoint]) -> None:
        """Log values, with those of training before those of the machine."""
        training = [point for point in points if not point.key.startswith("system/")]
        machine = [point for point in points if point.key.startswith("system/")]
        for step, group in groupby(sorted(training, key=lambda point: point.step), lambda point: point.step):
            self._log({point.key: point.value for point in group} | {"step": step}, step)
        for time_, group in groupby(machine, lambda point: point.time):
            self._log({point.key: point.value for point in group} | {"system/time": time_})

    def _log(self, values: dict[str, float], wanted: int = 0) -> None:
        """Log a row, under the wanted number if that is still free."""
        self.row = max(self.row + 1, wanted)
        self.run.log(values, step=self.row)

    def end(self, facts: RunFacts, results: Sequence[CurvePoint]) -> None:
        """Write results into the run's summary, and end it with the run's own status."""
        self.run.summary.update({point.key: point.value for point in results})
        self.run.summary.update({"status": facts.status, "reason": facts.reason})
        if facts.earlier:
            self.run.summary.update({"results by an earlier recipe": facts.earlier})
        for path in facts.files:
            self.run.save(str(path), base_path=str(facts.folder), policy="now")
        self.run.finish(exit_code=0 if facts.status == "done" else 1)

    def leave(self) -> None:
        """Close the run's file; a run that did not end counts as crashed."""
        self.run.finish(exit_code=1)
