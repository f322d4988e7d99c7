"""Every key of the config is changed once: an identity changes exactly where a stage's result does."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from memmlp.common.overrides import flatten
from memmlp.config.build import build_experiment
from memmlp.config.compose import compose_config
from memmlp.deploy.deployment import GRAPHS
from memmlp.motion.dataset import MotionDataset
from memmlp.runs.identity import NEUTRAL
from memmlp.runs.run import Run
from memmlp.training import loop
from memmlp.training.compute import StepCompute
from memmlp.training.run_stages import Experiment, make_prerequisites
from memmlp.training.train_network import TrainingJob

BASE = [
    "profile=tiny", "data=mocap", "data.root=clips", "data.split.groups=[]", "memory.shift=frame",
    "data.min_frames=12",
    "loggers=all", "threads=1", "optim.steps=4", "vqvae.steps=3",
    "optim.batch=4", "model.width=8", "model.frames=5", "model.depth=4", "memory.layers=[2]", "vqvae.width=8",
    "memory.width=4", "predictor.depth=1", "optim.checkpoint_every=9", "optim.validate_every=9",
    "evaluation.ik=lbfgs", "evaluation.ik_iterations=2", "optim.schedule=step", "optim.drop_at=0.5",
]  # fmt: skip

CHANGES: dict[str, str] = {
    "seed": "1", "device": "cpu", "threads": "2", "force": "true", "save_predictions": "elsewhere",
    "data.name": "other", "data.min_frames": "13", "data.strict": "true", "data.drawn_by": "clips",
    "data.mirror": "true", "data.split.test": "0.3", "data.split.val": "0.3",
    "data.split.train_fraction": "0.5",
    "data.split.seed": "1", "data.split.groups": "['[a-d]1']", "data.split.groups_file": "groups.csv",
    "normalizer.coordinates": "world", "normalizer.z_scores": "false", "normalizer.raw_inputs": "true",
    "model.frames": "6", "model.width": "12", "model.depth": "3",
    "memory.layers": "[2,4]", "memory.width": "5", "memory.shift": "window", "memory.history": "latest",
    "memory.fusion": "plain", "memory.blend": "1",
    "predictor.depth": "2",
    "vqvae.codes": "9", "vqvae.width": "9", "vqvae.encoder_depth": "1", "vqvae.decoder_depth": "2",
    "vqvae.commitment": "0.5", "vqvae.decay": "0.5", "vqvae.codebook": "gradient", "vqvae.steps": "4",
    "vqvae.batch": "16", "vqvae.lr": "1e-2", "vqvae.weight_decay": "0.1", "vqvae.seed": "5",
    "loss.lr": "1e-3",
    "optim.steps": "5", "optim.batch": "5", "optim.lr": "1e-2", "optim.final_lr": "1e-6",
    "optim.schedule": "cosine", "optim.drop_at": "0.9", "optim.weight_decay": "0.1",
    "optim.warmup": "3", "optim.ema": "0.9", "optim.tflop": "1e-5",
    "optim.clip_norm": "1e-3", "optim.eps": "1e-3", "optim.decoupled": "false",
    "optim.precision": "bf16", "optim.compile": "true", "optim.checkpoint_every": "1",
    "optim.validate_every": "1", "optim.validation_pieces": "1", "optim.log_every": "1",
    "evaluation.modes": "[stream]", "evaluation.batch": "1", "evaluation.ik": "off",
    "evaluation.ik_iterations": "3", "evaluation.metric_set": "agrol",
    "export.graph": "naive", "export.precision": "int8", "export.opset": "15", "export.latency_steps": "250",
    "export.alone": "true",
    "loggers.mlflow.uri": "sqlite:///other.db", "loggers.wandb.project": "other",
}  # fmt: skip

UNTRIED = {
    "paths.outputs", "plugins",  # change no run
    "imported_weights",  # set by import-weights: tests/networks/test_published_weights.py
    "data.root", "data.sources", "data.synth", "data.body",  # other clips or bodies are another digest
    "data.interpolation", "data.split.per_group", "data.split.divide",  # without use here: tests/motion
    "term", "evaluation.metrics",  # of a user's package: tests/config/test_plugins.py
    "prerequisite", "refiner",  # runs of their own: test_sage.py, test_refiner.py
    "vqvae.epochs",  # steps by another name
    "optim.best_by",  # keeps the weights of another validation: test_best_weights.py
}  # fmt: skip
LAST_DIGITS = {"threads", "device", "optim.compile", "data.min_frames"}
"""Keys that may leave every digit as it was: recorded and flagged, or of no effect here."""
NOWHERE = {
    "force", "save_predictions", "data.name", "data.strict", "optim.checkpoint_every", "optim.log_every",
    "optim.validate_every", "optim.validation_pieces", "evaluation.modes", "evaluation.batch",
    "loggers.mlflow.uri", "loggers.wandb.project",
}  # fmt: skip
"""Keys that change no result; what they do has tests of its own."""
TOGETHER = sorted(NOWHERE - {"evaluation.modes"})  # which leaves a mode out
"""Keys that are changed at once: where one of them moved something, all of them would."""


class Outcome(NamedTuple):
    """Identities and digests of the results of the training, each mode's evaluation and the deployment."""

    identities: dict[str, str]
    results: dict[str, str]


@pytest.fixture(scope="module", autouse=True)
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "measure_step", lambda task, optim: StepCompute(1e6, 0))  # a quarter of the time
        patch.chdir(tmp_path_factory.mktemp("identity"))
        clips(Path.cwd() / "clips")
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        yield Path.cwd()
        torch.set_num_threads(threads)


NAMES = ("a1", "a2", "b1", "b2", "c1", "c2", "d1", "d2")


def clips(folder: Path) -> None:
    """Eight short clips of an upright person who moves, and a file that groups them."""
    folder.mkdir()
    folder.with_name("groups.csv").write_text("clip,group\n" + "".join(f"{n},{n[0]}\n" for n in NAMES))
    for number, name in enumerate(NAMES):
        rng = np.random.default_rng(number)
        phase = np.linspace(0, 2, 14 + 2 * number)[:, None] + rng.uniform(0, 6, 156)
        poses = 0.2 * np.sin(phase) * rng.normal(size=156)
        poses[:, :3] = [np.pi / 2, 0, 0]
        trans = np.array([0, 0, 0.95]) + 0.1 * np.sin(phase[:, :3])
        np.savez(folder / f"{name}.npz", poses=poses, trans=trans, mocap_framerate=60.0)


@pytest.fixture(scope="module")
def base(home: Path) -> Outcome:
    return outcome(home / "base", [])


def outcome(folder: Path, overrides: list[str]) -> Outcome:
    """Make everything but the data in an empty folder, so that no run can be found by a wrong identity."""
    experiment = build_experiment(compose_config([*BASE, *overrides]))
    experiment.config["paths"]["outputs"] = str(folder)
    data = experiment.motion.prepare()
    identity = experiment.identity(data.digest)
    codes = make_prerequisites(replace(experiment, loggers=()), data).model
    run = Run(folder / "run")
    run.folder.mkdir(parents=True)
    experiment.training.train(TrainingJob(experiment.architecture, data, codes, run, experiment.device))
    model = experiment.architecture.load(run.model)
    found = data.open("test")
    ends = torch.tensor([0]), torch.tensor([11])
    short = MotionDataset(found.frames[:11], *ends, found.names[:1], found.groups[:1])
    evaluation = experiment.evaluation
    reports = {mode: evaluation.report(model, short, mode)["clips"] for mode in evaluation.modes}
    return Outcome(
        {"training": identity.id, **experiment.evaluations, "deployment": experiment.deployment_id},
        {
            "training": digest([t.tolist() for t in model.state_dict().values()]),
            **{mode: digest(rows) for mode, rows in reports.items()},
            "deployment": digest(deployed(experiment, model, short)),
        },
    )


def deployed(experiment: Experiment, model: Any, clip: MotionDataset) -> list[Any]:
    """Return what a deployment has: the graph's kind and numbers, its files, how often it is timed."""
    network = GRAPHS[experiment.deployment.graph](model)
    state, motions = network.initial_state(1), []
    with torch.no_grad():
        for t in range(7):
            motion, state = network.advance(clip.frames[None, t : t + 1, :54], state, 1)
            motions.append(motion.tolist())
    settings = experiment.deployment
    facts = settings.precision, settings.opset, settings.alone, max(settings.latency_steps, 200)
    return [type(network).__name__, *facts, motions]


def digest(value: Any) -> str:
    return hashlib.sha256(json.dumps(value).encode()).hexdigest()[:16]


def test_every_key_is_changed_or_said_not_to_be():
    """The profile's sizes are not changed here, since they act through the groups' keys, which are."""
    config = flatten(OmegaConf.to_container(compose_config(BASE), resolve=True))  # type: ignore[arg-type]
    own = {key for key in config if key.rsplit(".", 1)[-1] != "name"}
    own |= {"data.name"}  # a slot's own name is fixed
    assert {key for key in own if not key.startswith("profile.")} == CHANGES.keys() | UNTRIED


ALONE = [[key] for key in CHANGES if key not in {"optim.compile", *TOGETHER}]


@pytest.mark.parametrize("keys", [*ALONE, TOGETHER], ids=" ".join)
def test_identity_moves_exactly_where_a_result_moves(base: Outcome, home: Path, keys: list[str]):
    other = outcome(home / keys[0], [f"{key}={CHANGES[key]}" for key in keys])
    stages = base.results.keys() & other.results.keys()  # a mode that is not asked for is left out
    ids = {name: other.identities[name] != base.identities[name] for name in stages}
    moved = {name: ids["training"] or one for name, one in ids.items()}
    changed = {name: other.results[name] != base.results[name] for name in stages}
    if keys[0] in LAST_DIGITS:
        assert not any(changed.values()) or not any(moved.values())
    else:
        assert moved == changed
        assert any(moved.values()) == (keys[0] not in NOWHERE)


def test_neutral_keys_are_those_that_move_nothing():
    own = {key for key in CHANGES if not key.startswith(("data.", "evaluation."))}
    neutral = {key for key in own if any(key == name or key.startswith(f"{name}.") for name in NEUTRAL)}
    assert neutral == own & (NOWHERE | {"threads", "device"})
