"""Writes runs as W&B offline runs with the wandb package; `wandb sync` uploads them."""

from __future__ import annotations

import glob
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
from memmlp.common.settings import Settings, matching, setting
from memmlp.runs.loggers.logger import CurvePoint, RunFacts

OFFLINE = {"WANDB_MODE": "offline", "WANDB_SILENT": "true", "WANDB_ERROR_REPORTING": "false"}
FINGERPRINT = "memmlp-fingerprint"


@component("loggers", "wandb", builds="WandB")
@dataclass
class WandBSettings(Settings):
    """Writes runs as W&B offline runs to outputs/wandb (needs pip install 'memmlp[wandb]')."""

    # the project that `wandb sync` uploads to
    project: str = setting(matching(r"[^/\\#?%:\n]{1,128}", "text without / \\ # ? % : or newline"), "memmlp")


@dataclass(frozen=True)
class WandB:
    """Writes runs as W&B offline runs to outputs/wandb; `wandb sync` uploads them to `project`."""

    project: str
    outputs: Path

    name = "wandb"

    def __post_init__(self) -> None:
        check_installed("wandb", "wandb", "loggers=wandb")

    @property
    def place(self) -> str:
        return str(self.outputs.absolute() / "wandb")

    def fingerprint(self, run_id: str) -> str | None:
        """Return the fingerprint of the run's W&B offline run; None if the offline run has not ended."""
        files = (folder / FINGERPRINT for folder in self._find_folders(run_id))
        return next((file.read_text() for file in files if file.exists()), None)

    def begin(self, facts: RunFacts, points: Sequence[CurvePoint]) -> ShownInWandB:
        """Start a new offline run, and remove older ones of the same run."""
        origin = {**facts.origin, "folder": str(facts.folder)}
        os.environ.update(OFFLINE)
        import wandb

        stamps = {old.name.split("-")[2] for old in self._find_folders(facts.id)}
        for old in self._find_folders(facts.id):
            shutil.rmtree(old)
        while time.strftime("%Y%m%d_%H%M%S") in stamps:  # wandb would leave a folder with the same name empty
            time.sleep(0.05)
        Path(self.place).mkdir(parents=True, exist_ok=True)
        settings = wandb.Settings(
            console="off", silent=True, x_disable_stats=True, x_disable_meta=True,
            disable_git=True, disable_code=True, disable_job_creation=True,
        )  # fmt: skip
        run = wandb.init(
            project=self.project, id=facts.id, name=facts.name, dir=str(self.outputs.absolute()),
            mode="offline", settings=settings, reinit="create_new", tags=list(facts.tags),
            notes=facts.note or None, config={**facts.config, "run": origin},
        )  # fmt: skip
        shown = ShownInWandB(run, self._find_folders(facts.id)[0])
        shown.log(points)
        return shown

    def _find_folders(self, run_id: str) -> list[Path]:
        return list(Path(self.place).glob(f"offline-run-*-{run_id}"))


class ShownInWandB:
    """A run with an open W&B offline run."""

    def __init__(self, run: Any, folder: Path):
        self.run, self.folder = run, folder

    def log(self, points: Sequence[CurvePoint]) -> None:
        """Write the points of each step as a row of the run's history."""
        ordered = sorted(points, key=lambda point: point.step)
        for step, row in groupby(ordered, lambda point: point.step):
            self.run.log({point.key: point.value for point in row}, step=step)

    def end(self, facts: RunFacts) -> None:
        """Write results to the summary and upload files, then set the final status."""
        self.run.summary.update({point.key: point.value for point in facts.results} | facts.texts)
        for path in facts.files:
            literal = {"glob": False} if glob.escape(str(path)) != str(path) else {}  # new in wandb
            self.run.save(str(path), base_path=str(facts.folder), policy="now", **literal)
        self.run.finish(exit_code=0 if facts.status == "done" else 1)
        (self.folder / FINGERPRINT).write_text(facts.fingerprint)

    def close(self) -> None:
        """Close the offline run; W&B treats a run without an end as crashed."""
        self.run.finish(exit_code=1)
