"""A finished run with its experiment and data, for the commands that look at it again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from memmlp import pipeline
from memmlp.cli.build import build_experiment, config_of, device
from memmlp.data.dataset import Frames
from memmlp.data.prepare import Manifest
from memmlp.errors import InputError
from memmlp.identity import trained_by
from memmlp.runs import Run, find_run


class Opened(NamedTuple):
    """A finished run, what it was built of, and its prepared data."""

    run: Run
    experiment: pipeline.Experiment
    cache: Path
    manifest: Manifest

    @property
    def test(self) -> Frames:
        """The test clips, on the experiment's device."""
        return Frames.open(self.cache, "test").to(self.experiment.device)


def opened(outputs: Path, name: str, device_name: str = "cpu", overrides: Sequence[str] = ()) -> Opened:
    """The finished run of an id, of the beginning of one, or of a folder.

    Args:
        overrides: of keys of the evaluation and the deployment, KEY=VALUE.

    Raises:
        InputError: where there is none, an override is of its training, or its data is not what it was
            trained and tested on.
    """
    run = find_run(outputs, name)
    experiment = replace(build_experiment(config_of(run, overrides)), device=device(device_name))
    if trained_by(run.config) != trained_by(experiment.config):
        words = ", ".join(overrides)
        raise InputError(f"{words}: changes the training; allowed are keys of evaluation and export")
    cache, manifest = experiment.data.prepare()
    if manifest.digest != run.manifest["data"]:
        root = experiment.data.source.root
        raise InputError(f"run {run.id}: its data has changed since (data.root={root})")
    return Opened(run, experiment, cache, manifest)


def clip_of(test: Frames, name: str) -> Tensor:
    """All frames (N, 252) of a test clip. Raises InputError where there is none of that name."""
    return test.clip(clip_index(test, name))


def clip_index(test: Frames, name: str) -> int:
    """The place of a test clip. Raises InputError, which lists them, where there is none of that name."""
    if name not in test.names:
        raise InputError(f"--clip {name}: no such test clip; allowed are {', '.join(test.names)}")
    return test.names.index(name)
