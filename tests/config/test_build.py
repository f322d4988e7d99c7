"""Every value of every axis composes, builds, streams and differs from its base; trains, exports."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, NamedTuple

import pytest
import tiny
import torch
from omegaconf import DictConfig, OmegaConf

from memmlp.common.errors import InputError
from memmlp.config.build import build_experiment
from memmlp.config.compose import composed
from memmlp.deploy.export import export
from memmlp.deploy.parity import TOLERANCE, parity
from memmlp.evaluation import modes as evaluation
from memmlp.motion.dataset import MotionDataset
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.mem_mlp import MemMLP
from memmlp.runs.run import Run
from memmlp.training.experiment import Experiment
from memmlp.training.run_stages import make_prerequisites

TINY = [
    "profile=tiny", "data.synth.minutes=0.1", "loggers=none", "threads=1", "optim.steps=2", "vqvae.steps=2",
    "optim.batch=4", "model.width=8", "memory.width=4", "vqvae.width=8", "evaluation.ik_iterations=2",
]  # fmt: skip
SMALL = [
    "model.frames=5",
    "model.depth=2",
    "memory.layers=[2]",
    "predictor.depth=1",
]  # where the axis is none of them
LAYERS = ["model.frames=5", "predictor.depth=1"]

# The first value is the base of the axis. A value may need more than its key.
# Values that training has to do with are trained; of the others networks with random weights tell.
TRAINED: dict[str, tuple[list[str], list[list[str]]]] = {
    "memory": (SMALL, [[f"memory={name}"] for name in ("vq", "no_codes", "none", "vq_joint", "lstm", "gru")]),
    "predictor": (
        SMALL,
        [
            ["predictor=two_branch", "hand=fk"],
            ["predictor=two_branch_memory", "hand=fk"],
            ["predictor=rotation_only", "hand=fk"],
            ["predictor=rotation_only_memory", "hand=fk"],
        ],
    ),
    "vqvae.codebook": (SMALL, [["vqvae.codebook=ema"], ["vqvae.codebook=gradient"]]),
    "rollout": (SMALL, [[f"rollout={n}"] for n in ("teacher_forcing", "own_predictions", "streams")]),
    "rollout, lstm": (
        [*SMALL, "memory=lstm"],
        [[f"rollout={n}"] for n in ("teacher_forcing", "own_predictions", "streams")],
    ),
    "loss": (SMALL, [["loss=uncertainty"], ["loss=manual"]]),
    "hand": (SMALL, [["hand=position"], ["hand=fk"], ["hand=off"]]),
    "normalizer.coordinates": (
        SMALL,
        [[f"normalizer.coordinates={n}"] for n in ("heading", "head_relative", "world")],
    ),
    "normalizer.z_scores": (SMALL, [["normalizer.z_scores=true"], ["normalizer.z_scores=false"]]),
    "evaluation.ik": (SMALL, [["evaluation.ik=off"], ["evaluation.ik=lbfgs"], ["evaluation.ik=arms"]]),
    "evaluation.modes": (SMALL, [[f"evaluation.modes=[{n}]"] for n in ("window,stream", "stream", "window")]),
    "history": (
        SMALL,
        [
            ["memory.shift=window", "memory.history=first"],
            ["memory.shift=frame", "memory.history=latest", "memory.fusion=plain", "memory.blend=sampled"],
        ],
    ),
}
BUILT: dict[str, tuple[list[str], list[list[str]]]] = {
    "memory.layers": (LAYERS, [[f"memory.layers={v}"] for v in ("[2,4,6,8]", "[2]", "[2,4]", "[2,4,6]")]),
    "memory.shift": (SMALL, [["memory.shift=window"], ["memory.shift=frame"]]),
    "memory.history": (SMALL, [["memory.history=first"], ["memory.history=latest"]]),
    "memory.fusion": (SMALL, [["memory.fusion=residual"], ["memory.fusion=plain"]]),
    "memory.blend": (SMALL, [[f"memory.blend={m}"] for m in ("0.3", "0", "1", "sampled")]),
    "predictor.depth": (SMALL[:3], [[f"predictor.depth={n}"] for n in (2, 1, 4)]),
    "model.depth": ([*LAYERS, "memory.layers=[2]"], [[f"model.depth={n}"] for n in (8, 10, 12)]),
    "model.frames": (SMALL[1:], [[f"model.frames={n}"] for n in (11, 21, 41, 60)]),
    "vqvae.codes": (SMALL, [[f"vqvae.codes={n}"] for n in (64, 32, 128)]),
    "vqvae.encoder_depth": (SMALL, [[f"vqvae.encoder_depth={n}"] for n in (4, 2, 6)]),
    "vqvae.codes, joint": ([*SMALL, "memory=vq_joint"], [["vqvae.codes=64"], ["vqvae.codes=32"]]),
}
AXES = TRAINED | BUILT
CLIP = tiny.clip(12)


class Arm(NamedTuple):
    """A trained arm and what it did."""

    model: MemMLP
    values: list[dict[str, float]]
    motion: torch.Tensor
    results: dict[str, Any]


@pytest.fixture
def home(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder whose outputs the tests of a process share; pieces to validate on are a second long."""
    monkeypatch.setattr("memmlp.training.train_network.VALIDATION_PIECE", 60)
    if "axes" not in FOLDERS:
        FOLDERS["axes"] = tmp_path_factory.mktemp("axes")
    monkeypatch.chdir(FOLDERS["axes"])
    return FOLDERS["axes"]


FOLDERS: dict[str, Path] = {}
ARMS: dict[str, Arm] = {}


def trained(overrides: list[str]) -> Arm:
    """Two steps, a validation, and the first test clip evaluated as the config says; once for each config."""
    cfg = composed(overrides)
    key = OmegaConf.to_yaml(cfg)
    if key not in ARMS:
        ARMS[key] = train_and_stream(cfg)
    return ARMS[key]


def train_and_stream(cfg: DictConfig) -> Arm:
    experiment = build_experiment(cfg)
    data = experiment.motion.prepare()
    above = make_prerequisites(experiment, data)
    run = Run(Path(mkdtemp(dir=".", prefix="arm-")))
    weights = above.model if above else None
    model = experiment.training.train(experiment.architecture, data, weights, run, experiment.device)
    test = data.open("test")
    short = MotionDataset(test.frames[:12], torch.tensor([0]), torch.tensor([12]), test.names[:1])
    torch.manual_seed(0)
    results = evaluation.evaluate(model, short, experiment.evaluation.modes, 4, experiment.evaluation.ik)
    torch.manual_seed(0)
    motion = evaluation.stream(model, [short.frames])[0]
    return Arm(model, [entry.values for entry in run.metrics()], motion, results["mean"])


def arguments(axis: str, value: list[str]) -> list[str]:
    """The command line of an axis' value; keys that its memory has not are left out."""
    overrides = [*TINY, *AXES[axis][0], *value]
    return [text for text in overrides if "memory=none" not in value or not text.startswith("memory.")]


@pytest.mark.slow
@pytest.mark.parametrize("axis", TRAINED)
def test_every_value_trains_streams_and_changes_something(axis, home):
    base, *others = [trained(arguments(axis, value)) for value in TRAINED[axis][1]]
    for arm in (base, *others):
        assert arm.motion.shape == (12, 198)
        assert torch.isfinite(arm.motion).all()
        assert [torch.isfinite(torch.tensor([*values.values()])).all() for values in arm.values] == [True] * 2
    for value, arm in zip(TRAINED[axis][1][1:], others, strict=True):
        assert differences(base, arm), value


def differences(a: Arm, b: Arm) -> set[str]:
    """In what two arms differ."""
    branches = [{mode: set(of) for mode, of in arm.results.items()} for arm in (a, b)]
    same = {
        "weights": shapes(a.model) == shapes(b.model),
        "loss": a.values[0] == b.values[0],
        "motion": torch.allclose(a.motion, b.motion, atol=1e-6),
        "results": branches[0] == branches[1],
    }
    return {name for name, equal in same.items() if not equal}


def shapes(model: MemMLP) -> dict[str, torch.Size]:
    return {name: tensor.shape for name, tensor in model.state_dict().items()}


@pytest.mark.slow
def test_the_same_arm_again_is_no_different(home):
    overrides = [*TINY, *SMALL]
    assert differences(trained(overrides), train_and_stream(composed(overrides))) == set()


@pytest.mark.slow
@pytest.mark.parametrize("axis", BUILT)
def test_every_value_builds_streams_and_changes_the_network(axis):
    """Its weights' shapes, or else what it makes of a clip with the same random weights."""
    base, *others = [network(arguments(axis, value)) for value in BUILT[axis][1]]
    motion = streamed(base)
    for value, other in zip(BUILT[axis][1][1:], others, strict=True):
        moved = not torch.allclose(streamed(other), motion)
        assert moved or shapes(other) != shapes(base), value


@torch.no_grad()
def streamed(model: MemMLP) -> torch.Tensor:
    """What a network makes of a clip."""
    torch.manual_seed(0)
    motion = evaluation.stream(model, [CLIP])[0]
    assert motion.shape == (12, 198)
    assert torch.isfinite(motion).all()
    return motion


def test_the_same_network_again_is_no_different():
    base, again = (network([*TINY, *SMALL]) for _ in range(2))
    assert shapes(base) == shapes(again)
    assert torch.equal(streamed(base), streamed(again))


SHORT = "normalizer.coordinates=head_relative"  # whose graphs are two thirds of those with a heading
EXPORTED = [
    ["memory=no_codes", "memory.fusion=plain", SHORT],
    ["memory=vq_joint", "memory.blend=sampled", SHORT],
    ["memory=lstm", "predictor=two_branch_memory", SHORT],
    ["memory=gru", "predictor=rotation_only_memory", "hand=fk", SHORT],
    ["memory=none", "normalizer.coordinates=world", "predictor=rotation_only", "hand=off"],
    ["memory=vq", "memory.shift=frame", "memory.history=latest", "normalizer.coordinates=heading"],
]  # every value that makes another graph; the other axes have the same graph with other numbers


@pytest.mark.slow
@pytest.mark.parametrize("overrides", EXPORTED, ids=" ".join)
def test_every_kind_of_graph_exports(overrides, tmp_path):
    """With random weights and codes, over a clip of noise."""
    shared = [text for text in [*TINY, *SMALL] if "memory=none" not in overrides or "memory." not in text]
    codes = [] if "memory=none" in overrides else ["vqvae.encoder_depth=1", "vqvae.decoder_depth=1"]
    model = network([*shared, *codes, *overrides])
    export(model, tmp_path / "step.onnx", "0" * 16)
    clip = torch.randn(12, 252, generator=torch.Generator().manual_seed(0))
    assert parity(model, tmp_path / "step.onnx", clip) <= TOLERANCE


def network(overrides: list[str]) -> MemMLP:
    """The network of a command line, with random weights and codes."""
    torch.manual_seed(0)
    architecture = build_experiment(composed(overrides)).architecture
    codes = architecture.vqvae() if architecture.uses_codes else None
    model = architecture.build(Normalizer.raw(architecture.coordinates, tiny.REST), codes)
    for name, buffer in model.named_buffers():
        if name.endswith("codebook.vectors"):
            buffer.normal_()
    return model.eval()


GROUPS: dict[str, list[str]] = {
    "memory": ["vq", "no_codes", "none", "vq_joint", "lstm", "gru"],
    "memory.shift": ["frame"],
    "memory.history": ["latest"],
    "memory.fusion": ["plain"],
    "memory.blend": ["1", "sampled"],
    "predictor": ["two_branch", "two_branch_memory", "rotation_only", "rotation_only_memory"],
    "rollout": ["teacher_forcing", "own_predictions", "streams"],
    "loss": ["uncertainty", "manual"],
    "hand": ["position", "fk", "off"],
    "normalizer.coordinates": ["heading", "head_relative", "world"],
    "evaluation.ik": ["off", "lbfgs", "arms"],
    "vqvae.codebook": ["ema", "gradient"],
    "loggers": ["mlflow", "none", "tensorboard", "wandb", "all"],
}
OPTIONS = [f"{group}={option}" for group, options in GROUPS.items() for option in options]
PAIRS = [(a, b) for a, b in combinations(OPTIONS, 2) if a.split("=")[0] != b.split("=")[0]]
RECURRENT = ("memory=lstm", "memory=gru")


def refused(options: tuple[str, str]) -> str:
    """What the one line names where a pair is refused, or nothing."""
    rotation_only = any(option.startswith("predictor=rotation_only") for option in options)
    of_memory = next((o.split("=")[0] for o in options if o.startswith("memory.")), "")
    if rotation_only and "hand=position" in options:
        return "hand=position"
    if rotation_only and "evaluation.ik=lbfgs" in options:
        return "evaluation.ik=lbfgs"
    if "memory=none" in options and any(option.endswith("_memory") for option in options):
        return "memory=none"
    if {"memory=none", "rollout=own_predictions"} == set(options):
        return "rollout=own_predictions"
    if {"memory.shift=frame", "rollout=own_predictions"} == set(options):
        return "rollout.max_passes"
    if of_memory and "memory=none" in options:
        return of_memory
    if of_memory not in ("", "memory.fusion") and set(RECURRENT) & set(options):
        return of_memory
    return ""


def rows() -> list[list[str]]:
    """Lists of options that hold, all together, every pair that is not refused."""
    left = {pair for pair in PAIRS if not refused(pair)}
    made = []
    while left:
        row = list(min(left))
        for group in GROUPS:
            fitting = [o for o in OPTIONS if o.startswith(f"{group}=") and fits(o, row)]
            row += sorted(fitting, key=lambda o: -len(left & pairs_of(o, row)))[:1]
        made.append(row)
        left -= {pair for pair in PAIRS if set(pair) <= set(row)}
    return made


def fits(option: str, row: list[str]) -> bool:
    """Whether an option may join a row of options of other groups."""
    group = option.split("=")[0]
    return all(o.split("=")[0] != group and not refused(pair) for o in row for pair in pairs_of(option, [o]))


def pairs_of(option: str, row: list[str]) -> set[tuple[str, str]]:
    """An option's pairs with those of a row, in the order of OPTIONS."""
    return {tuple(sorted((option, other), key=OPTIONS.index)) for other in row}


@pytest.mark.slow
def test_all_pairs_of_options_of_different_groups_go_together():
    made = rows()
    assert {pair for row in made for pair in combinations(sorted(row, key=OPTIONS.index), 2)} >= {
        pair for pair in PAIRS if not refused(pair)
    }
    for row in made:
        assert network(["profile=tiny", *row]).count_parameters() > 0


REFUSED = [(list(pair), refused(pair)) for pair in PAIRS if refused(pair)]
REFUSED += [(["predictor=two_branch_memory", "predictor.depth=0"], "predictor.depth=0")]


@pytest.mark.slow
def test_what_cannot_go_together_is_refused_in_one_line():
    for overrides, word in REFUSED:
        rotation_only = any(option.startswith("predictor=rotation_only") for option in overrides)
        hand = ["hand=fk"] if rotation_only and not any(o.startswith("hand=") for o in overrides) else []
        with pytest.raises(InputError) as stop:
            composed(["profile=tiny", *overrides, *hand])
        assert word in str(stop.value), overrides
        assert "\n" not in str(stop.value)


def test_every_protocol_builds(tmp_path):
    (tmp_path / "CMU").mkdir()
    for part in ("train", "test"):
        (tmp_path / "CMU" / f"{part}_split.txt").write_text(f"CMU/{part}.npz\n")
    for name in ("s1", "s2", "s3"):
        lists = [f"data.split.folder={tmp_path}"] if name == "s1" else []
        cfg = composed([f"data=amass_{name}", f"data.root={tmp_path}", *lists])
        assert build_experiment(cfg).config["data"]["name"] == f"amass_{name}"


@pytest.mark.slow
def test_a_joint_vqvae_is_part_of_the_runs_identity_and_its_own_stage_is_not():
    def experiment_of(*overrides: str) -> Experiment:
        return build_experiment(composed(["memory=vq_joint", *overrides]))

    def identity(*overrides: str) -> str:
        return experiment_of(*overrides).identity("data").id

    base = identity()
    assert all(identity(change) != base for change in ("vqvae.codes=32", "vqvae.encoder_depth=2"))
    assert all(identity(change) == base for change in ("vqvae.steps=7", "vqvae.lr=0.5", "loggers=none"))
    assert experiment_of().identities("data") == [experiment_of().identity("data")]


def test_a_refiner_has_a_rate_of_its_own_and_its_network_keeps_its():
    words = [*TINY, "refiner=sage", "optim.lr=4e-3", "optim.final_lr=4e-4"]
    plain, own = (build_experiment(composed([*words, *more])) for more in ([], ["refiner.lr=1e-3"]))
    assert plain.training.optim.lr == 4e-3
    assert (own.training.optim.lr, own.training.optim.final_lr) == (1e-3, pytest.approx(1e-4))
    assert own.unrefined.training.optim.lr == 4e-3
