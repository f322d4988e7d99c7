"""Opens a finished run with its experiment and data, for the commands that use it again.

This is in config because only config builds experiments from configs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from memmlp.common.errors import InputError
from memmlp.common.overrides import parse_overrides
from memmlp.config.build import build_experiment, config_of
from memmlp.motion.dataset import MotionDataset
from memmlp.motion.motion_source import Prepared
from memmlp.networks.motion_model import MotionModel
from memmlp.runs.identity import DEPLOYMENT, EVALUATION, INFERENCE, select_training_config
from memmlp.runs.lookup import find_run
from memmlp.runs.run import Run
from memmlp.training.devices import choose_device
from memmlp.training.run_stages import Experiment

ACTING = (*EVALUATION, *DEPLOYMENT, "data", "paths", "plugins", "loggers")
"""The groups with keys that affect a finished run; the keys of INFERENCE do, too."""


class OpenedRun(NamedTuple):
    """A finished run, the experiment that its config describes, and its prepared data."""

    run: Run
    experiment: Experiment
    data: Prepared

    @property
    def test(self) -> MotionDataset:
        """The test clips, on the experiment's device."""
        return self.data.open("test").to(self.experiment.device)

    def network(self) -> MotionModel:
        """The trained network, in evaluation mode, on the experiment's device."""
        return trained_network(self.run, self.experiment)


def open_run(outputs: Path, name: str, device_name: str = "cpu", overrides: Sequence[str] = ()) -> OpenedRun:
    """Open a finished run.

    Args:
        outputs: the folder of runs and caches.
        name: the run's id, the beginning of one, or the run's folder.
        device_name: the device to compute on: "auto", "cpu", "cuda", "cuda:INDEX" or "mps".
        overrides: KEY=VALUE for keys of the evaluation and the export.

    Raises:
        InputError: if there is no such run, an override would change its training or nothing at all, or its
            data has changed since it was trained and tested.
    """
    return open_found(find_run(outputs, name), device_name, overrides)


def open_found(run: Run, device_name: str = "cpu", overrides: Sequence[str] = ()) -> OpenedRun:
    """Open a run that was already found; see `open_run`."""
    experiment = experiment_of(run, device_name, overrides)
    return OpenedRun(run, experiment, data_of(run, experiment))


def data_of(run: Run, experiment: Experiment) -> Prepared:
    """Return the prepared data of a run. Raises InputError if it has changed since the training."""
    # What it was trained on may be looked at, however much of its list that is: the digest proves it.
    data = replace(experiment.motion, partial=True).prepare()
    if data.digest != run.manifest["data"]:
        root = experiment.motion.clips.root
        raise InputError(f"run {run.id}: its data has changed since (data.root={root})")
    return data


def experiment_of(run: Run, device_name: str = "cpu", overrides: Sequence[str] = ()) -> Experiment:
    """Return the experiment of a finished run, without its data; raises InputError as `open_run` does."""
    experiment = replace(
        build_experiment(config_of(run, overrides), elsewhere=True), device=choose_device(device_name)
    )
    if select_training_config(run.config) != select_training_config(experiment.config):
        words = ", ".join(overrides)
        raise InputError(f"{words}: changes the training; set keys of evaluation and export only")
    for word in parse_overrides(overrides):
        if word.group not in ACTING and word.key not in INFERENCE:  # such as force=true
            raise InputError(f"{word}: no effect on a finished run; set keys of evaluation and export only")
    return experiment


def trained_network(run: Run, experiment: Experiment) -> MotionModel:
    """Return the trained network of a run, in evaluation mode, on the experiment's device."""
    return experiment.architecture.load(run.weights()).to(experiment.device)


def clip_of(test: MotionDataset, name: str, key: str = "--clip") -> Tensor:
    """Return all frames (N, 252) of a test clip. Raises InputError if there is no clip with that name."""
    return test.clip(clip_index(test, name, key))


def clip_index(test: MotionDataset, name: str, key: str = "--clip") -> int:
    """Return the index of a test clip.

    Args:
        test: the test clips.
        name: the clip's name.
        key: the option or argument that gave the name, for the error.

    Raises:
        InputError: if there is no clip with that name; the message lists the names.
    """
    if name not in test.names:
        raise InputError(f"{key} {name}: must be a test clip of the run's data: {', '.join(test.names)}")
    return test.names.index(name)
