"""Every option of every group trains, streams and differs from its base; every kind of graph exports."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, NamedTuple

import pytest
import tiny
import torch
from omegaconf import OmegaConf

from memmlp.config.build import build_experiment, make_readable_name
from memmlp.config.compose import compose_config
from memmlp.deploy.export import export
from memmlp.deploy.parity import TOLERANCE, measure_largest_difference
from memmlp.evaluation import modes as evaluation
from memmlp.motion.dataset import MotionDataset
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.mem_mlp import MemMLP
from memmlp.runs.run import Run
from memmlp.training.run_stages import Experiment, make_prerequisites
from memmlp.training.train_network import TrainingJob

TINY = [
    "profile=tiny", "data.synth.minutes=0.1", "loggers=none", "threads=1", "optim.steps=2", "vqvae.steps=2",
    "optim.batch=4", "model.width=8", "memory.width=4", "vqvae.width=8", "evaluation.ik_iterations=2",
]  # fmt: skip
SMALL = ["model.frames=5", "model.depth=2", "memory.layers=[2]", "predictor.depth=1"]  # unless an axis

# By axis: the keys beside it and its values, the first of which is the base. What follows a comma is no key.
# Keys with numbers are changed in tests/training/test_experiment.py.
TRAINED: dict[str, tuple[list[str], str]] = {
    "memory": (SMALL, "vq no_codes none vq_joint lstm gru"),
    "predictor": (
        [*SMALL, "hand=fk"], "two_branch two_branch_memory rotation_only rotation_only_memory"
    ),
    "rollout": (SMALL, "teacher_forcing own_predictions streams"),
    "loss": (SMALL, "uncertainty manual"),
    "hand": (SMALL, "position fk off"),
    "evaluation.ik": (SMALL, "off lbfgs arms"),
}  # fmt: skip


class Arm(NamedTuple):
    model: MemMLP
    values: list[dict[str, float]]
    motion: torch.Tensor
    results: dict[str, Any]


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder whose outputs the tests share; pieces to validate on are a second long."""
    folder = tmp_path_factory.mktemp("axes")
    with pytest.MonkeyPatch.context() as patch, contextlib.chdir(folder):
        patch.setattr("memmlp.training.train_network.VALIDATION_PIECE", 60)
        yield folder


@functools.cache
def trained(*overrides: str) -> Arm:
    """Two steps, a validation, and the first test clip evaluated as the config says."""
    experiment = build_experiment(compose_config(overrides))
    data = experiment.motion.prepare()
    above = make_prerequisites(experiment, data)
    run = Run(Path(mkdtemp(dir=".", prefix="arm-")))
    weights = above.model if above else None
    experiment.training.train(TrainingJob(experiment.architecture, data, weights, run, experiment.device))
    model = experiment.architecture.load(run.model)
    test = data.open("test")
    short = MotionDataset(test.frames[:12], torch.tensor([0]), torch.tensor([12]), test.names[:1])
    settings = experiment.evaluation
    results = {mode: settings.report(model, short, mode)["mean"] for mode in settings.modes}
    torch.manual_seed(0)
    motion = evaluation.predict_stream(model, [short.frames])[0]
    return Arm(model, [entry.values for entry in run.metrics()], motion, results)


def variants(axis: str) -> list[list[str]]:
    """The command lines of an axis' values; keys that a value's memory has not are left out."""
    beside, values = TRAINED[axis]
    words = [f"{axis.partition(',')[0]}={value}" for value in values.split()]
    return [
        [text for text in (*TINY, *beside, word) if word != "memory=none" or not text.startswith("memory.")]
        for word in words
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    "axis", ["memory", *(pytest.param(axis, marks=pytest.mark.long) for axis in list(TRAINED)[1:])]
)
def test_every_value_trains_streams_and_changes_something(axis, home):
    base, *others = (trained(*words) for words in variants(axis))
    for arm in (base, *others):
        assert arm.motion.shape == (12, 198)
        assert torch.isfinite(arm.motion).all()
        assert [torch.isfinite(torch.tensor([*values.values()])).all() for values in arm.values] == [True] * 2
    for value, arm in zip(variants(axis)[1:], others, strict=True):
        same = shapes(base.model) == shapes(arm.model) and base.values[0] == arm.values[0]
        branches = [{mode: set(of) for mode, of in one.results.items()} for one in (base, arm)]
        same = same and branches[0] == branches[1] and torch.allclose(base.motion, arm.motion, atol=1e-6)
        assert not same, value


def shapes(model: MemMLP) -> dict[str, torch.Size]:
    return {name: tensor.shape for name, tensor in model.state_dict().items()}


EXPORTED = [
    ["memory=vq_joint", "memory.blend=sampled", "memory.shift=frame", "memory.history=latest",
     "predictor=two_branch_memory", "normalizer.coordinates=heading"],
    ["memory=gru", "predictor=rotation_only_memory", "hand=fk", "normalizer.coordinates=head_relative"],
    ["memory=no_codes", "memory.fusion=plain", "predictor=rotation_only", "hand=off",
     "normalizer.coordinates=world"],
]  # fmt: skip
"""Values that make another graph; other memories' graphs are in tests/exported.py."""


@pytest.mark.long
@pytest.mark.parametrize("overrides", EXPORTED, ids=" ".join)
def test_every_kind_of_graph_exports(overrides, tmp_path):
    model = network([*TINY, *SMALL, "vqvae.encoder_depth=1", "vqvae.decoder_depth=1", *overrides])
    export(model, tmp_path / "step.onnx", "0" * 16)
    clip = torch.randn(12, 252, generator=torch.Generator().manual_seed(0))
    assert measure_largest_difference(model, tmp_path / "step.onnx", clip) <= TOLERANCE


def network(overrides: list[str]) -> MemMLP:
    torch.manual_seed(0)
    architecture = build_experiment(compose_config(overrides)).architecture
    codes = architecture.vqvae() if architecture.uses_codes else None
    model = architecture.build(Normalizer.from_coordinates(architecture.coordinates, tiny.REST), codes)
    for name, buffer in model.named_buffers():
        if name.endswith("codebook.vectors"):
            buffer.normal_()
    return model.eval()


@pytest.mark.slow
def test_a_joint_vqvae_is_part_of_the_runs_identity_and_its_own_stage_is_not():
    def experiment_of(*overrides: str) -> Experiment:
        return build_experiment(compose_config(["memory=vq_joint", *overrides]))

    def identity(*overrides: str) -> str:
        return experiment_of(*overrides).identity("data").id

    base = identity()
    assert all(identity(change) != base for change in ("vqvae.codes=32", "vqvae.encoder_depth=2"))
    assert all(identity(change) == base for change in ("vqvae.steps=7", "vqvae.lr=0.5", "loggers=none"))
    assert experiment_of().compute_identities("data") == [experiment_of().identity("data")]


def test_a_refiner_has_a_rate_of_its_own_and_its_network_keeps_its():
    words = [*TINY, "refiner=sage", "optim.lr=4e-3", "optim.final_lr=4e-4"]
    plain, own = (build_experiment(compose_config([*words, *more])) for more in ([], ["refiner.lr=1e-3"]))
    assert plain.training.optim.lr == 4e-3
    assert (own.training.optim.lr, own.training.optim.final_lr) == (1e-3, pytest.approx(1e-4))
    assert own.unrefined.training.optim.lr == 4e-3


pytestmark = pytest.mark.slow


def config(*words: str) -> dict[str, Any]:
    found: Any = OmegaConf.to_container(compose_config(list(words)), resolve=True)
    return found


def name(*words: str) -> str:
    return make_readable_name("memmlp", config(*words))


@pytest.mark.parametrize(("words", "expected"), [
    ("seed=1", "default · seed 1"),
    ("memory=gru seed=1", "memory=gru · seed 1"),
    ("memory=gru memory.layers=[2]", "memory=gru · memory.layers=[2] · seed 0"),
    ("model=bodiffusion", "model=bodiffusion · seed 0"),
    ("model=bodiffusion optim.ema=null", "model=bodiffusion · optim.ema=null · seed 0"),
    ("profile=paper optim.lr=0.01", "profile=paper · optim.lr=0.01 · seed 0"),
    ("profile.width=64", "profile.width=64 · seed 0"),
    ("data.drawn_by=clips device=cpu threads=1 loggers=none evaluation.modes=[window]",
     "data.drawn_by=clips · seed 0"),
])  # fmt: skip
def test_what_differs(words: str, expected: str):
    assert name(*words.split()) == expected


def test_a_vqvae_and_a_component_of_ones_own():
    whole = config()
    codes = {"normalizer": whole["normalizer"], "vqvae": whole["vqvae"] | {"codes": 9, "seed": 4}}
    assert make_readable_name("vqvae", codes) == "VQ-VAE · vqvae.codes=9 · seed 4"
    mine = whole | {"memory": {"name": "mine", "knob": 3}}
    assert make_readable_name("memmlp", mine) == "memory=mine · seed 0"
