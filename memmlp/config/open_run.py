"""Opens finished runs with their experiments and data, and makes runs from published weights."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor, nn

from memmlp.common.components import find_component, list_component_names
from memmlp.common.errors import InputError
from memmlp.common.files import file_digest
from memmlp.common.overrides import format_value, parse_overrides
from memmlp.common.text_formats import make_override
from memmlp.config.build import build_experiment, load_config
from memmlp.config.compose import compose_config
from memmlp.evaluation.metric_facts import METRIC_SETS
from memmlp.motion.body import ROTATION, load_rest_joints
from memmlp.motion.dataset import MotionDataset
from memmlp.motion.motion_source import PreparedMotion, ShippedMotion
from memmlp.motion.normalizer import Normalizer
from memmlp.networks import checkpoint
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.refiner import RefinedModel, SAGERefinerSettings
from memmlp.networks.settings import Release
from memmlp.runs.identity import INFERENCE, STAGE_GROUPS, select_training_config
from memmlp.runs.lookup import find_run, find_shipped_clip, get_shipped_name
from memmlp.runs.run import Run
from memmlp.training.devices import choose_device
from memmlp.training.request import Outcome
from memmlp.training.run_stages import Experiment, run_experiment
from memmlp.training.train_network import PublishedWeights, WeightsImport

EFFECTIVE_GROUPS = (*STAGE_GROUPS, "data", "paths", "plugins", "loggers")
"""The groups with an effect on the use of a finished run. The keys in INFERENCE also have an effect."""


@dataclass(frozen=True)
class OpenedRun:
    """A finished run with its experiment. The network and the data are loaded when they are used."""

    run: Run
    experiment: Experiment

    @cached_property
    def data(self) -> PreparedMotion | ShippedMotion:
        """The prepared data. Raises InputError if it has changed since the training.

        For a shipped network without data.root=FOLDER, the data is the shipped clip.
        """
        run, motion = self.run, self.experiment.motion
        root = self.experiment.config["data"]["root"]
        if get_shipped_name(run) and Path(root) == find_shipped_clip().parent:
            return ShippedMotion(find_shipped_clip(), load_rest_joints(str(motion.clips.body)))
        # Clips of the list may be missing, as long as the digest matches the training data.
        try:
            data = replace(motion, partial=True).prepare()
        except InputError as error:
            raise InputError(f"run {run.id}: needs the data of its training ({error})") from None
        if data.digest != run.manifest["data"]:
            raise InputError(f"run {run.id}: its data has changed since the training (data.root={root})")
        return data

    @property
    def test(self) -> MotionDataset:
        """The test clips, on the experiment's device."""
        return self.data.open("test").to(self.experiment.device)

    def network(self) -> MotionModel:
        """The trained network, in evaluation mode, on the experiment's device."""
        return self.experiment.architecture.load(self.run.weights()).to(self.experiment.device)


def open_run(outputs: Path, name: str, device_name: str = "cpu", overrides: Sequence[str] = ()) -> OpenedRun:
    """Open a finished run in `outputs`, given its id, the beginning of one, or its folder, with overrides of
    the evaluation and the export. Raises InputError if the run does not exist, or an override would change
    its training or have no effect."""
    run = find_run(outputs, name)
    return OpenedRun(run, build_run_experiment(run, device_name, overrides, outputs))


def open_existing_run(run: Run) -> OpenedRun:
    """Open a finished run like `open_run`, from its `Run` object, on the CPU."""
    return OpenedRun(run, build_run_experiment(run))


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


def import_weights(
    name: str,
    path: Path,
    overrides: Sequence[str],
    statistics: Sequence[Path] = (),
    refiner: Path | None = None,
) -> Outcome:
    """Make a finished run from a checkpoint that a network's authors publish, and evaluate and deploy it.

    The checkpoint's shapes and the network's Release set sizes and options; the overrides win.

    Args:
        name: the network's option of `model`.
        path: the checkpoint.
        overrides: overrides KEY=VALUE, such as the data.
        statistics: the files with mean and standard deviation of the rotations, for a network with z-scores;
            by default, those of the training clips are used.
        refiner: the checkpoint of SAGE-Net's refiner, to put behind the network.

    Raises:
        InputError: if the checkpoint cannot be read, or does not fit the network and the overrides.
    """
    network = find_component("model", name)
    models = {one: find_component("model", one).settings for one in list_component_names("model")}
    releases = {one: release for one, kind in models.items() if (release := getattr(kind, "release", None))}
    if (release := releases.get(name)) is None:
        raise InputError(f"{name}: has no published weights; must be {' or '.join(releases)}")
    kind: type[MotionModel] = network.kind
    files = [path, *([refiner] if refiner else [])]
    vectors = checkpoint.read_published_statistics(statistics, ROTATION.stop) if statistics else None
    digest = hashlib.sha256("".join(map(file_digest, (*files, *statistics))).encode()).hexdigest()
    tensors, sizes = _read_published(path, release)
    refining, more = _read_published(refiner, SAGERefinerSettings.release) if refiner else ({}, {})
    released_test = next(key for key, one in METRIC_SETS.items() if one.source == release.source)
    values = {"profile": "paper", "evaluation.metric_set": released_test, **release.config, **sizes, **more}
    words = [f"model={name}", *(["refiner=sage"] if refiner else [])]
    words += [f"{key}={format_value(value)}" for key, value in values.items()]
    cfg = compose_config([*words, *overrides, make_override("imported_weights", digest[:16])])
    if statistics and not cfg.normalizer.z_scores:
        raise InputError(f"--mean: must be left out with model={name}, which does not normalise the motion")
    experiment = build_experiment(cfg)
    architecture = experiment.architecture
    model = architecture.build(
        Normalizer.from_coordinates(architecture.coordinates, torch.zeros(22, 3)), None
    )
    own = model.network if isinstance(model, RefinedModel) and refiner else model
    renamed = _rename_published(path, kind.adapt_published(tensors), release, own)
    if refiner and isinstance(model, RefinedModel):
        parts = nn.ModuleDict({"layers": model.layers, "head": model.head})
        renamed = {f"network.{key}": tensor for key, tensor in renamed.items()}
        renamed |= _rename_published(refiner, refining, SAGERefinerSettings.release, parts)
    origin = {"model": name, "source": release.source}
    origin |= {"file": " + ".join(one.name for one in files), "sha256": " + ".join(map(file_digest, files))}
    training = experiment.training
    assert isinstance(training, WeightsImport)
    training = replace(training, published=PublishedWeights(renamed, vectors, origin))
    return run_experiment(replace(experiment, training=training))


def _read_published(path: Path, release: Release) -> tuple[dict[str, Tensor], dict[str, int]]:
    tensors = checkpoint.read_published(path)
    with _naming_checkpoint(path):
        return tensors, checkpoint.find_published_sizes(tensors, release)


def _rename_published(
    path: Path, tensors: Mapping[str, Tensor], release: Release, module: nn.Module
) -> dict[str, Tensor]:
    with _naming_checkpoint(path):
        return checkpoint.rename_published(tensors, release, dict(module.named_parameters()))


@contextmanager
def _naming_checkpoint(path: Path) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def find_clip(test: MotionDataset, name: str, key: str = "--clip") -> Tensor:
    """Return all frames (N, 252) of a test clip. Raises InputError, which begins with `key`, for an unknown
    name."""
    if name not in test.names:
        raise InputError(f"{key} {name}: must be one of the run's test clips ({', '.join(test.names)})")
    return test.read_clip(test.names.index(name))
