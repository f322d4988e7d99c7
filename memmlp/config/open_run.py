"""Opens finished runs with their experiments and data, for evaluation, export and live use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from memmlp.common.errors import InputError
from memmlp.common.overrides import parse_overrides
from memmlp.config.build import build_experiment, load_config
from memmlp.motion.body import load_rest_joints
from memmlp.motion.dataset import MotionDataset
from memmlp.motion.motion_source import PreparedMotion, ShippedMotion
from memmlp.networks.motion_model import MotionModel
from memmlp.runs.identity import DEPLOYMENT, EVALUATION, INFERENCE, select_training_config
from memmlp.runs.lookup import find_run, find_shipped_clip, get_shipped_name
from memmlp.runs.run import Run
from memmlp.training.devices import choose_device
from memmlp.training.run_stages import Experiment

EFFECTIVE_GROUPS = (*EVALUATION, *DEPLOYMENT, "data", "paths", "plugins", "loggers")
"""The groups with an effect on the use of a finished run. The keys in INFERENCE also have an effect."""


class OpenedRun(NamedTuple):
    """A finished run with its experiment and prepared data."""

    run: Run
    experiment: Experiment
    data: PreparedMotion | ShippedMotion

    @property
    def test(self) -> MotionDataset:
        """The test clips, on the experiment's device."""
        return self.data.open("test").to(self.experiment.device)

    def network(self) -> MotionModel:
        """The trained network, in evaluation mode, on the experiment's device."""
        return load_network(self.run, self.experiment)


def open_run(outputs: Path, name: str, device_name: str = "cpu", overrides: Sequence[str] = ()) -> OpenedRun:
    """Open a finished run in `outputs`, given its id, the beginning of one, or its folder, with overrides of
    the evaluation and the export. Raises InputError if the run does not exist, an override would change its
    training or have no effect, or its data has changed since the training."""
    run = find_run(outputs, name)
    experiment = build_run_experiment(run, device_name, overrides, outputs)
    return OpenedRun(run, experiment, load_run_data(run, experiment))


def open_existing_run(run: Run) -> OpenedRun:
    """Open a finished run like `open_run`, from its `Run` object, on the CPU."""
    experiment = build_run_experiment(run)
    return OpenedRun(run, experiment, load_run_data(run, experiment))


def load_run_data(run: Run, experiment: Experiment) -> PreparedMotion | ShippedMotion:
    """Return the prepared data of a run. Raises InputError if the data has changed since the training.

    For a shipped network without data.root=FOLDER, the data is the shipped clip.
    """
    root = experiment.config["data"]["root"]
    if get_shipped_name(run) and Path(root) == find_shipped_clip().parent:
        return ShippedMotion(find_shipped_clip(), load_rest_joints(str(experiment.motion.clips.body)))
    # Clips of the list may be missing, as long as the digest matches the training data.
    data = replace(experiment.motion, partial=True).prepare()
    if data.digest != run.manifest["data"]:
        raise InputError(f"run {run.id}: its data has changed since the training (data.root={root})")
    return data


def build_run_experiment(
    run: Run, device_name: str = "cpu", overrides: Sequence[str] = (), outputs: Path | None = None
) -> Experiment:
    """Return the experiment of a finished run, without its data. By default, caches are in the outputs folder
    that contains the run. Raises InputError like `open_run`."""
    cfg = load_config(run, overrides, outputs)
    experiment = replace(build_experiment(cfg, remote=True), device=choose_device(device_name))
    if select_training_config(run.config) != select_training_config(experiment.config):
        words = ", ".join(overrides)
        raise InputError(f"{words}: would change the training; set only keys of evaluation and export")
    for word in parse_overrides(overrides):
        if word.group not in EFFECTIVE_GROUPS and word.key not in INFERENCE:  # such as force=true
            raise InputError(f"{word}: has no effect on a finished run; set keys of evaluation and export")
    return experiment


def load_network(run: Run, experiment: Experiment) -> MotionModel:
    """Return the trained network of a run, in evaluation mode, on the experiment's device."""
    return experiment.architecture.load(run.weights()).to(experiment.device)


def find_clip(test: MotionDataset, name: str, key: str = "--clip") -> Tensor:
    """Return all frames (N, 252) of a test clip. Raises InputError for an unknown name."""
    return test.read_clip(find_clip_index(test, name, key))


def find_clip_index(test: MotionDataset, name: str, key: str = "--clip") -> int:
    """Return the index of a test clip. Raises InputError for an unknown name; the message begins with the
    option or argument `key`, and lists the names."""
    if name not in test.names:
        raise InputError(f"{key} {name}: must be one of the run's test clips ({', '.join(test.names)})")
    return test.names.index(name)
