"""A whole experiment: data, VQ-VAE run, motion network's run, its evaluations, its deployment.

Each stage has an identity (memmlp.identity), is found where it was made before, and is made where it was not.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from memmlp import checkpoint, evaluation
from memmlp.body import SPARSE_DIM
from memmlp.data.dataset import Frames
from memmlp.data.motion import Motion
from memmlp.data.prepare import Manifest
from memmlp.deployment import Deployment
from memmlp.features import Frame, World
from memmlp.files import read_json, write_json
from memmlp.identity import (
    Identity,
    deployment_id,
    deployment_settings,
    evaluation_id,
    evaluation_recipes,
    evaluation_settings,
)
from memmlp.ik import IK
from memmlp.losses import Loss
from memmlp.memory import Memory
from memmlp.model import MemMLP, WindowModel
from memmlp.predictor import Predictor
from memmlp.rollout import PersistentStreams, Rollout
from memmlp.runs import Run, write_report
from memmlp.tracking import Tracker, project_safely
from memmlp.training import MotionTask, Optim, VQVAETask, Watch, train, unwatched
from memmlp.vqvae import VQVAE

VALIDATION_PIECE = 240  # frames: validation streams through pieces of clips of 4 s
PICTURE_FRAMES = 600  # the picture shows the first 10 s of the first test clip
VQVAE_SETTINGS = ("codes", "width", "encoder_depth", "decoder_depth", "commitment", "decay", "codebook")


@dataclass(frozen=True)
class Architecture:
    """What builds a family's network: this, and `build`.

    Attributes:
        coordinates, normalize: of world <-> network space.
        vqvae: makes a VQ-VAE.
    """

    coordinates: World
    normalize: bool
    vqvae: Callable[[], VQVAE]

    @property
    def uses_codes(self) -> bool:
        """Whether the network wants a frozen VQ-VAE."""
        return False

    @property
    def trains_codes(self) -> bool:
        """Whether the network has a VQ-VAE of its own, trained with it."""
        return False

    def build(self, frame: Frame, codes: VQVAE | None) -> WindowModel:
        """The network with fresh weights."""
        raise NotImplementedError

    def frame(self, manifest: Manifest, frames: Tensor) -> Frame:
        """World <-> network space, with the statistics of the training frames (F, 252) where asked."""
        rest = torch.as_tensor(np.asarray(manifest.rest), dtype=torch.float32)
        if self.normalize:
            return Frame.fit(self.coordinates, rest, frames)
        return Frame.raw(self.coordinates, rest)

    def load(self, run: Run) -> WindowModel:
        """The network of a finished run."""
        tensors, _ = checkpoint.read(run.weights())
        codes = self.vqvae() if self.uses_codes else None
        model = self.build(Frame.raw(self.coordinates, torch.zeros(22, 3)), codes)
        checkpoint.load_module("model", model, tensors)
        return model.eval()


@dataclass(frozen=True)
class MemMLPArchitecture(Architecture):
    """Mem-MLP: partial constructors for the slots, and its sizes."""

    frames: int
    hidden: int
    depth: int
    memory: Callable[..., Memory]
    memory_kind: type[Memory]
    predictor: Callable[..., Predictor]

    @property
    def uses_codes(self) -> bool:
        """Whether the memory wants a frozen VQ-VAE."""
        return self.memory_kind.uses_codes

    @property
    def trains_codes(self) -> bool:
        """Whether the memory has a VQ-VAE of its own."""
        return self.memory_kind.trains_codes

    def build(self, frame: Frame, codes: VQVAE | None) -> MemMLP:
        """The network with fresh weights."""
        sizes = {"hidden": self.hidden, "frames": self.frames}
        memory = self.memory(codes=codes, depth=self.depth, **sizes)
        predictor = self.predictor(memory_block=memory.memory_block, **sizes)
        return MemMLP(frame, memory, predictor, depth=self.depth, **sizes)


@dataclass(frozen=True)
class ReferenceArchitecture(Architecture):
    """A network without slots: its constructor, all but world <-> network space given."""

    network: Callable[[Frame], WindowModel]

    def build(self, frame: Frame, codes: VQVAE | None) -> WindowModel:
        """The network with fresh weights."""
        return self.network(frame)


@dataclass(frozen=True)
class Experiment:
    """All that a run needs, as built objects; `config` is the record of where they came from."""

    config: dict[str, Any]
    outputs: Path
    device: torch.device
    seed: int
    force: bool
    data: Motion
    architecture: Architecture
    vqvae_config: dict[str, Any]
    vqvae_optim: Callable[[int], Optim]  # of the number of training frames
    vqvae_seed: int
    loss: Callable[[frozenset[str]], Loss]
    rollout: Rollout
    optim: Optim
    weighting: str  # of the windows' draws
    modes: Sequence[str]
    evaluation_batch: int
    ik: IK
    deployment: Deployment
    save_predictions: Path | None
    tracker: Tracker

    @property
    def evaluations(self) -> dict[str, str]:
        """The identity of the evaluation in each of the modes."""
        return {mode: evaluation_id(self.config, mode) for mode in self.modes}

    @property
    def deployed(self) -> str:
        """The identity of the deployment."""
        return deployment_id(self.config)

    @property
    def stages(self) -> tuple[str, ...]:
        """The identities of all that is made of the trained network."""
        return (*self.evaluations.values(), self.deployed)


@dataclass(frozen=True)
class Outcome:
    """A run as an experiment asks for it.

    Attributes:
        made: the stages that were made just now: "training", "evaluation", "deployment".
        results: mode -> branch -> metric, and "latency".
    """

    run: Run
    made: tuple[str, ...]
    results: dict[str, Any]


def run(experiment: Experiment, watch: Watch = unwatched) -> Outcome:
    """Bring the experiment's run to its end, doing only what is missing.

    `watch` is called after each validation with the step and its values, and may raise to stop the run.
    """
    cache, manifest = experiment.data.prepare()
    upstream = vqvae_run(experiment, cache, manifest) if experiment.architecture.uses_codes else None
    run = Run.of(experiment.outputs, motion_identity(experiment, manifest.digest).id)
    with run.lock():
        if experiment.force:
            run.reset()
        made = []
        if not run.done:
            train_run(experiment, run, cache, manifest, upstream, watch)
            made.append("training")
        made += finish(experiment, run, cache)
        if experiment.save_predictions is not None:
            model = experiment.architecture.load(run).to(experiment.device)
            save_predictions(experiment, model, cache)
    if made:
        project_safely(experiment.tracker, run)
    return Outcome(run, tuple(made), results_of(experiment, run))


def finished(
    experiment: Experiment, run: Run, cache: Path, again: bool = False
) -> tuple[dict[str, Any], list[str]]:
    """What was measured of a trained run as the experiment asks for it, and the stages that were made for it.

    again: evaluate anew what was evaluated before.
    """
    with run.lock():
        if again:
            evaluate_run(experiment, run, cache, experiment.modes)
        made = [*(["evaluation"] if again else []), *finish(experiment, run, cache)]
    if made:
        project_safely(experiment.tracker, run)
    return results_of(experiment, run), made


def finish(experiment: Experiment, run: Run, cache: Path) -> list[str]:
    """Make what is missing of a trained run's evaluations and deployment; the names of the stages made."""
    made = []
    missing = [mode for mode, identity in experiment.evaluations.items() if not run.has(identity)]
    if missing:
        evaluate_run(experiment, run, cache, missing)
        made.append("evaluation")
    if not run.has(experiment.deployed):
        deploy_run(experiment, run, cache)
        made.append("deployment")
    return made


def results_of(experiment: Experiment, run: Run) -> dict[str, Any]:
    """What was measured of a run as the experiment asks for it: mode -> branch -> metric, and "latency"."""
    files = {mode: run.evaluation(name) for mode, name in experiment.evaluations.items() if run.has(name)}
    latency = read_json(run.deployment(experiment.deployed).latency)
    means = {mode: read_json(path)["mean"] for mode, path in files.items()}
    return means | ({"latency": latency} if latency else {})


def clip_rows(experiment: Experiment, run: Run) -> list[dict[str, Any]]:
    """Each test clip's name, frames, and metrics by mode and branch, as the experiment asks for them."""
    rows: dict[str, dict[str, Any]] = {}
    for mode, name in experiment.evaluations.items():
        for clip in read_json(run.evaluation(name))["clips"]:
            facts = {key: value for key, value in clip.items() if not isinstance(value, dict)}
            branches = {key: value for key, value in clip.items() if isinstance(value, dict)}
            rows.setdefault(clip["name"], facts)[mode] = branches
    return list(rows.values())


def vqvae_identity(experiment: Experiment, data: str) -> Identity | None:
    """The identity of the VQ-VAE run that the experiment needs on data of that digest, if it needs one."""
    if not experiment.architecture.uses_codes:
        return None
    return Identity("vqvae", experiment.vqvae_config, data)


def motion_identity(experiment: Experiment, data: str) -> Identity:
    """The identity of the experiment's run on data of that digest."""
    # A frozen VQ-VAE's own identity stands for its config; a joint one is not trained by that stage's keys.
    own = {key: value for key, value in experiment.config.items() if key != "vqvae"}
    if experiment.architecture.trains_codes:
        own["vqvae"] = {key: experiment.config["vqvae"][key] for key in VQVAE_SETTINGS}
    return Identity("memmlp", own, data, vqvae_identity(experiment, data))


def begin(experiment: Experiment, run: Run, identity: Identity, config: dict[str, Any]) -> None:
    """Begin a training: its config, and in its manifest what it is and what it runs on."""
    above = identity.upstream.id if identity.upstream else None
    facts = {"recipes": identity.recipes, "what": identity.what, **machine(experiment)}
    run.begin(identity.kind, config, data=identity.data, upstream=above, **facts)


def machine(experiment: Experiment) -> dict[str, Any]:
    """What can change the last digits of a result: device, graphics processor, threads, precision."""
    cuda = experiment.device.type == "cuda"
    return {
        "device": str(experiment.device),
        "gpu": torch.cuda.get_device_name(experiment.device) if cuda else None,
        "threads": torch.get_num_threads(),
        "precision": experiment.optim.precision,
    }


def vqvae_run(experiment: Experiment, cache: Path, manifest: Manifest) -> Run:
    """The finished run of the VQ-VAE that this configuration needs, trained where it is missing."""
    identity = vqvae_identity(experiment, manifest.digest)
    assert identity is not None
    run = Run.of(experiment.outputs, identity.id)
    with run.lock():
        if run.done:
            return run
        begin(experiment, run, identity, experiment.vqvae_config)
        started = time.monotonic()
        frames, validation = (Frames.open(cache, split).to(experiment.device) for split in ("train", "val"))
        torch.manual_seed(experiment.vqvae_seed)
        frame = experiment.architecture.frame(manifest, frames.frames).to(experiment.device)
        model = experiment.architecture.vqvae().to(experiment.device)
        optim = experiment.vqvae_optim(len(frames.frames))
        task = VQVAETask(model, frame, frames, validation, optim, experiment.vqvae_seed)
        train(task, optim, run, experiment.vqvae_seed, "VQ-VAE")
        checkpoint.write(run.model, checkpoint.module_tensors("model", model), {})
        write_json(run.results_path, {"val": task.validate()})
        run.write_manifest({"seconds": {"train": round(time.monotonic() - started, 1)}})
        run.finish(("model.safetensors", "results.json"))
    project_safely(experiment.tracker, run)
    return run


def load_vqvae(architecture: Architecture, run: Run) -> VQVAE:
    """The VQ-VAE of a finished run."""
    model = architecture.vqvae()
    checkpoint.load_module("model", model, checkpoint.read(run.weights())[0])
    return model.eval()


def train_run(
    experiment: Experiment, run: Run, cache: Path, manifest: Manifest, upstream: Run | None, watch: Watch
) -> None:
    """Train one network, and mark its run as done."""
    begin(experiment, run, motion_identity(experiment, manifest.digest), experiment.config)
    run.write_manifest({"body": manifest.body})
    run.clear_stages()
    started = time.monotonic()
    model = trained(experiment, run, cache, manifest, upstream, watch)
    checkpoint.write(run.model, checkpoint.module_tensors("model", model), {})
    note_seconds(run, "train", started)
    run.finish(("model.safetensors",))


def evaluate_run(experiment: Experiment, run: Run, cache: Path, modes: Sequence[str]) -> None:
    """Evaluate a trained run in some modes, each a file that is there whole or not at all."""
    run.attempt("evaluation")
    started = time.monotonic()
    model = experiment.architecture.load(run).to(experiment.device)
    test = Frames.open(cache, "test").to(experiment.device)
    for mode in modes:
        torch.manual_seed(experiment.seed)  # for a blend that is sampled: alike in whatever order
        found = evaluation.evaluate(model, test, [mode], experiment.evaluation_batch, experiment.ik)
        rows = [{key: row[key] for key in ("name", "group", "frames")} | row[mode] for row in found["clips"]]
        settings, name = evaluation_settings(experiment.config, mode), experiment.evaluations[mode]
        report = {"mode": mode, "run": run.manifest["id"], "name": name, "settings": settings}
        report |= {"recipes": evaluation_recipes(settings), **machine(experiment)}
        write_report(run.evaluation(name), report | {"mean": found["mean"][mode], "clips": rows})
    if not (run.folder / "poses.png").exists():
        picture(model, test, run)
    note_seconds(run, "evaluate", started)


def deploy_run(experiment: Experiment, run: Run, cache: Path) -> None:
    """Export a trained run, prove the file, and time it."""
    run.attempt("deployment")
    started = time.monotonic()
    model = experiment.architecture.load(run)
    clips = [Frames.open(cache, split).clips() for split in ("train", "test")]
    place = run.deployment(experiment.deployed)
    place.latency.unlink(missing_ok=True)  # of one that is made again, as a file of it is gone
    record = experiment.deployment.ship(model, place, run.id, *clips)
    place.finish({"run": run.manifest["id"], "settings": deployment_settings(experiment.config), **record})
    note_seconds(run, "export", started)


def note_seconds(run: Run, stage: str, started: float) -> None:
    """Add to the manifest how long a stage took, since a time of the monotonic clock."""
    seconds = run.manifest.get("seconds") or {}
    run.write_manifest({"seconds": {**seconds, stage: round(time.monotonic() - started, 1)}})


def trained(
    experiment: Experiment,
    run: Run,
    cache: Path,
    manifest: Manifest,
    upstream: Run | None,
    watch: Watch = unwatched,
) -> WindowModel:
    """The trained network, its training resumed where it was left."""
    architecture, device = experiment.architecture, experiment.device
    frames = Frames.open(cache, "train").to(device)
    torch.manual_seed(experiment.seed)
    codes = load_vqvae(architecture, upstream) if upstream else None
    model = architecture.build(architecture.frame(manifest, frames.frames), codes).to(device)
    if isinstance(experiment.rollout, PersistentStreams):
        experiment.rollout.build(model)
    pieces = evaluation.chunks(Frames.open(cache, "val").to(device), VALIDATION_PIECE, least=60)
    task = MotionTask(
        model,
        experiment.loss(model.branches).to(device),
        experiment.rollout.to(device),
        frames,
        experiment.optim,
        experiment.seed,
        validate=lambda network: evaluation.quick_stream(network, pieces),
        weighting=experiment.weighting,
    )
    train(task, experiment.optim, run, experiment.seed, "network", watch)
    return model.eval()


def picture(model: WindowModel, test: Frames, run: Run) -> None:
    """Draw the start of the first test clip, streamed."""
    from memmlp.render.figure import poses_png  # with matplotlib: half a second that planning needs not

    device = model.frame.rest.device
    clip = test.clip(0)[:PICTURE_FRAMES].to(device)
    motion = evaluation.stream(model, [clip])[0]
    predicted = model.frame.pose(motion, clip[:, :SPARSE_DIM])
    truth = evaluation.joint_positions(clip[:, SPARSE_DIM:])
    poses_png(run.folder / "poses.png", truth.cpu().numpy(), predicted.cpu().numpy(), test.names[0])


def save_predictions(experiment: Experiment, model: WindowModel, cache: Path) -> None:
    """Write `<folder>/<mode>/<clip>.npz` for every test clip: positions (N, 22, 3) and rotations."""
    assert experiment.save_predictions is not None
    test = Frames.open(cache, "test").to(experiment.device)
    clips = test.clips()
    for mode in experiment.modes:
        motions = evaluation.predict(model, clips, mode, experiment.evaluation_batch)
        for name, clip, motion in zip(test.names, clips, motions, strict=True):
            path = experiment.save_predictions / mode / f"{name}.npz"
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savez(path, allow_pickle=False, **prediction_arrays(model.frame, clip, motion, experiment.ik))


def prediction_arrays(frame: Frame, clip: Tensor, motion: Tensor, ik: IK) -> dict[str, np.ndarray]:
    """What a prediction file holds: metres in the world, local rotation matrices, float32.

    `predicted_positions` are those of the rotation branch by forward kinematics, the head on its tracker;
    what inverse kinematics makes of the branches follows as `combined_positions` and `combined_rotations`.
    """
    sparse, truth = clip[:, :SPARSE_DIM], clip[:, SPARSE_DIM:]
    arrays = {
        "predicted_positions": frame.pose(motion, sparse),
        "predicted_positions_of_position_branch": evaluation.joint_positions(motion),
        "true_positions": evaluation.joint_positions(truth),
        "predicted_rotations": evaluation.local_rotations(motion),
        "true_rotations": evaluation.local_rotations(truth),
    }
    for name, solved in ik.solutions(frame, motion, sparse).items():
        arrays[f"{name}_positions"] = frame.pose(solved, sparse)
        arrays[f"{name}_rotations"] = evaluation.local_rotations(solved)
    return {name: tensor.cpu().numpy() for name, tensor in arrays.items()}
