"""Writes runs as W&B's offline runs, with W&B's own client; `wandb sync` uploads them."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from memmlp.common.components import component
from memmlp.common.errors import check_installed
from memmlp.common.settings import Settings, setting, text
from memmlp.runs.loggers.logger import CurvePoint, RunFacts

OFFLINE = {"WANDB_MODE": "offline", "WANDB_SILENT": "true", "WANDB_ERROR_REPORTING": "false"}
FINGERPRINT = "memmlp-fingerprint"


@component("loggers", "wandb", builds="WandB")
@dataclass
class WandBSettings(Settings):
    """Writes runs as W&B's offline runs below outputs/wandb (needs pip install 'memmlp[wandb]')."""

    project: str = setting(text(), "memmlp")  # to which `wandb sync` uploads


@dataclass(frozen=True)
class WandB:
    """Shows runs as W&B's offline runs below outputs/wandb, each replaced when its run begins.

    Attributes:
        project: the project to which `wandb sync` uploads them.
        outputs: the outputs folder.

    Raises:
        InputError: if wandb is not installed.
    """

    project: str
    outputs: Path

    name = "wandb"

    def __post_init__(self) -> None:
        check_installed("wandb", "wandb", "loggers=wandb")

    @property
    def place(self) -> str:
        """The folder of the offline runs."""
        return str(self.outputs.absolute() / "wandb")

    def fingerprint(self, run_id: str) -> str | None:
        """Return the fingerprint of the facts with which a run ended; None if it did not."""
        files = (folder / FINGERPRINT for folder in self._folders(run_id))
        return next((file.read_text() for file in files if file.exists()), None)

    def begin(self, facts: RunFacts, points: Sequence[CurvePoint]) -> ShownInWandB:
        """Write a run from its beginning; an earlier offline run of it is removed."""
        config = {**facts.config, "run": {**facts.origin, "folder": str(facts.folder)}}
        run = self._start(
            facts.id, facts.name, tags=list(facts.tags), notes=facts.note or None, config=config
        )
        shown = ShownInWandB(run, self._folders(facts.id)[0])
        shown.log(points)
        return shown

    def _start(self, run_id: str, name: str, **options: Any) -> Any:
        os.environ.update(OFFLINE)
        import wandb

        stamps = {old.name.split("-")[2] for old in self._folders(run_id)}
        for old in self._folders(run_id):
            shutil.rmtree(old)
        while time.strftime("%Y%m%d_%H%M%S") in stamps:  # a folder of the same name would stay empty
            time.sleep(0.05)
        Path(self.place).mkdir(parents=True, exist_ok=True)
        settings = wandb.Settings(
            console="off", silent=True, x_disable_stats=True, x_disable_meta=True,
            disable_git=True, disable_code=True, disable_job_creation=True,
        )  # fmt: skip
        return wandb.init(
            project=self.project, id=run_id, name=name, dir=str(self.outputs.absolute()),
            mode="offline", settings=settings, reinit="create_new", **options,
        )  # fmt: skip

    def _folders(self, run_id: str) -> list[Path]:
        return list(Path(self.place).glob(f"offline-run-*-{run_id}"))


class ShownInWandB:
    """A run that W&B's client has open, in a folder."""

    def __init__(self, run: Any, folder: Path):
        self.run, self.folder = run, folder

    def log(self, points: Sequence[CurvePoint]) -> None:
        """Log the values of each step as a row of W&B's history."""
        ordered = sorted(points, key=lambda point: point.step)
        for step, row in groupby(ordered, lambda point: point.step):
            self.run.log({point.key: point.value for point in row}, step=step)

    def end(self, facts: RunFacts) -> None:
        """Write results into the run's summary, and end it with the run's own status."""
        self.run.summary.update({point.key: point.value for point in facts.results} | facts.texts)
        for path in facts.files:
            self.run.save(str(path), base_path=str(facts.folder), policy="now")
        self.run.finish(exit_code=0 if facts.status == "done" else 1)
        (self.folder / FINGERPRINT).write_text(facts.fingerprint)

    def close(self) -> None:
        """Close the run's file; a run that did not end counts as crashed."""
        self.run.finish(exit_code=1)
