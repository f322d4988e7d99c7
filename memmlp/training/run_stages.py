"""Run an experiment: data, prerequisite runs, the network's run, evaluations and deployment. A stage whose id
(memmlp.runs.identity) exists is reused."""

from __future__ import annotations

import contextlib
import getpass
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from memmlp.common import distributed
from memmlp.common.errors import InputError, LeaseLost, TrainingDiverged, is_disk_error, is_interruption
from memmlp.common.files import write_json
from memmlp.common.progress import announce, keep_announcements, notify
from memmlp.deploy.deployment import Deployment
from memmlp.evaluation.modes import Evaluation, predict_first_clip
from memmlp.evaluation.predictions import save_predictions
from memmlp.live.pose_latency import measure_pose_times
from memmlp.motion.dataset import MotionDataset
from memmlp.motion.motion_source import PreparedMotion
from memmlp.networks.architectures import Architecture
from memmlp.networks.motion_model import MotionModel
from memmlp.runs.environment import PREREQUISITES, list_prerequisite_origins
from memmlp.runs.evaluation_file import write_report
from memmlp.runs.identity import (
    NETWORK,
    Identity,
    find_evaluation_versions,
    select_deployment_settings,
    select_evaluation_settings,
)
from memmlp.runs.loggers.logger import RunLogger, show_run
from memmlp.runs.run import Run
from memmlp.training.devices import describe_device, describe_unused_gpu
from memmlp.training.loop import ValidationCallback
from memmlp.training.request import (
    Outcome,
    RunRequest,
    announce_data,
    collect_data_warnings,
    describe_missing_data,
    describe_user_code,
    list_missing_modes,
    read_results,
)
from memmlp.training.train_network import NetworkTraining, Training, TrainingJob
from memmlp.training.train_refiner import RefinerTraining


@dataclass(frozen=True)
class Experiment(RunRequest):
    """A request with the built objects that its runs need. Each of the `prerequisites` uses the run before
    it. `make_name` makes a readable name for a run from its kind and its config. `unrefined` is the
    experiment of the network without its refiner; None without a refiner."""

    device: torch.device
    architecture: Architecture
    prerequisites: tuple[Training, ...]
    training: NetworkTraining | RefinerTraining
    evaluation: Evaluation
    deployment: Deployment | None
    loggers: Sequence[RunLogger]
    make_name: Callable[[str, Mapping[str, Any]], str] = lambda kind, config: kind
    unrefined: Experiment | None = None


def run_in_processes(experiment: Experiment) -> Outcome | None:
    """Run the experiment in this process, or together with the other processes of torchrun; return the
    outcome in the first process, None in the others. The first process holds the run's lock, prepares the
    data, writes files, evaluates and deploys. It broadcasts which stage to train next."""
    if experiment.unrefined and distributed.world_size() > 1:
        raise InputError("refiner: must be null with several processes; or start one process")
    distributed.connect(experiment.device.type)
    if not distributed.is_first():
        _train_named_stages(experiment)
        return None
    outcome = run_experiment(experiment)
    distributed.broadcast("end")
    distributed.disconnect()
    return outcome


def make_job(
    experiment: Experiment, data: PreparedMotion, before: Run | None, run: Run,
    on_validation: ValidationCallback | None = None,
) -> TrainingJob:  # fmt: skip
    """Return the job of training a run from the weights of the run `before`."""
    weights = before.weights() if before else None
    return TrainingJob(experiment.architecture, data, weights, run, experiment.device, on_validation)


def _train_named_stages(experiment: Experiment) -> None:
    """Train the stages that the first process broadcasts, until it broadcasts "end"."""
    while (stage := distributed.broadcast("")) != "end":
        data = experiment.motion.prepare()  # the first process has prepared it
        identities = experiment.compute_identities(data.digest)
        runs = [Run.from_id(experiment.outputs, identity.id) for identity in identities]
        number = [identity.kind for identity in identities].index(stage)
        training = (*experiment.prerequisites, experiment.training)[number]
        training.train(make_job(experiment, data, runs[number - 1] if number else None, runs[number]))
    distributed.disconnect()


def run_experiment(experiment: Experiment, on_validation: ValidationCallback | None = None) -> Outcome:
    """Run the missing stages of the experiment. `on_validation` is called after each validation with the step
    and its values; it may raise to end the run."""
    config = experiment.config
    data = experiment.motion.prepare()
    announce_data(data)
    run = Run.from_id(experiment.outputs, experiment.identity(data.digest).id)
    if not run.done:
        if experiment.evaluations:
            data.open("test")  # reports missing test clips before the training, not after it
        optim = experiment.training.optim
        optim.check_installed()
        if optim.best_by and not data.has("val"):
            raise InputError(f"optim.best_by={optim.best_by}: must be null without validation clips")
        if overlooked := describe_unused_gpu(config["device"]):
            notify(overlooked)
    before = None if run.done and not config["force"] else make_prerequisites(experiment, data)
    with run.lock():
        if config["force"]:
            run.reset()
        new_stages = []
        with record_outcome(experiment, run):
            if not run.done:
                # Another process may have restarted the run in the meantime.
                before = before or make_prerequisites(experiment, data)
                train_run(experiment, run, data, before, on_validation)
                new_stages.append("training")
            new_stages += make_missing_stages(experiment, run, data)
        if folder := config["save_predictions"]:
            model = experiment.architecture.load(run.weights()).to(experiment.device)
            test = data.open("test").to(experiment.device)
            save_predictions(experiment.evaluation, model, test, Path(folder))
    return Outcome(run, tuple(new_stages), read_results(experiment, run), experiment.stage_ids)


def complete_stages(
    experiment: Experiment, run: Run, data: PreparedMotion, again: bool = False
) -> tuple[dict[str, Any], list[str]]:
    """Run the missing evaluations (with `again`, all) and deployment of a trained run; return its results and
    the names of the stages that were run."""
    with run.lock(), record_outcome(experiment, run, again):
        if again:
            evaluate_run(experiment, run, data, experiment.evaluation.modes)
        new_stages = [*(["evaluation"] if again else []), *make_missing_stages(experiment, run, data)]
    return read_results(experiment, run), new_stages


def make_missing_stages(experiment: Experiment, run: Run, data: PreparedMotion) -> list[str]:
    """Run the missing evaluations and deployment of a trained run; return the names of the stages that were
    run."""
    new_stages = []
    run.request_stages(experiment.stage_ids)
    run.check_not_stopped()
    if missing := list_missing_modes(experiment, run):
        if any(run.has(experiment.evaluations[mode]) for mode in missing):
            announce("evaluation: the code of custom metrics has changed, so they are measured again")
        evaluate_run(experiment, run, data, missing)
        new_stages.append("evaluation")
    if experiment.deployment_id and not run.has(experiment.deployment_id):
        deploy_run(experiment, run, data)
        new_stages.append("deployment")
    return new_stages


def make_prerequisites(experiment: Experiment, data: PreparedMotion, last: str | None = None) -> Run | None:
    """Train the missing prerequisite runs in order, up to the run id `last`; return the last run, or None."""
    if experiment.unrefined:
        return run_experiment(experiment.unrefined).run
    run: Run | None = None
    identities = experiment.compute_identities(data.digest)
    for training, identity in zip(experiment.prerequisites, identities, strict=False):
        run = find_or_train(experiment, training, identity, data, run)
        if run.id == last:
            break
    return run


def find_or_train(
    experiment: Experiment, training: Training, identity: Identity, data: PreparedMotion, before: Run | None
) -> Run:
    """Return the prerequisite run with that identity; train it from the run `before` if necessary."""
    run = Run.from_id(experiment.outputs, identity.id)
    with run.lock():
        if run.done:
            return run
        with record_outcome(experiment, run):
            run.check_not_stopped()
            begin_run(experiment, run, identity, dict(identity.config), before)
            run.write_manifest({"partial": describe_missing_data(experiment.config, data)})
            announce(f"{training.description} (run {run.id})")
            distributed.broadcast(training.kind)  # tells the other processes what to train
            errors = training.train(make_job(experiment, data, before, run))
            write_json(run.results_path, {"val": errors})
            run.finish(("model.safetensors", "results.json"))
    return run


@contextlib.contextmanager
def record_outcome(experiment: Experiment, run: Run, again: bool = False) -> Iterator[None]:
    """Report work on a run to the loggers, and record failures of the work itself in the run's folder: not
    bad input, interruptions, a full disk, a closed output pipe, or the loss of the run to another process."""
    missing = again or not run.done or not all(map(run.has, experiment.stage_ids))
    missing = missing or bool(list_missing_modes(experiment, run))
    loggers = experiment.loggers if missing else ()
    with show_run(run, loggers), keep_announcements(run.log_path):
        try:
            yield
        except (LeaseLost, BrokenPipeError):
            raise
        except TrainingDiverged as error:
            run.fail(str(error))
            raise
        except (RuntimeError, OSError) as error:
            if not is_disk_error(error) and not is_interruption(error):
                run.fail(f"{type(error).__name__}: {error}", traceback.format_exc())
            raise
        run.reset_deaths()


def train_run(
    experiment: Experiment,
    run: Run,
    data: PreparedMotion,
    before: Run | None,
    on_validation: ValidationCallback | None = None,
) -> None:
    """Train a run's network from the weights of the run `before`, and mark the run as done."""
    run.check_not_stopped()
    announce(f"{experiment.training.description} (run {run.id})")
    begin_run(experiment, run, experiment.identity(data.digest), experiment.config, before)
    facts = {"body": data.manifest.body, "validation_clips": len(data.manifest.part("val"))}
    run.write_manifest(facts | collect_data_warnings(experiment.config, data))
    run.request_stages(experiment.stage_ids)
    run.clear_stages()
    distributed.broadcast(NETWORK)  # tells the other processes what to train
    experiment.training.train(make_job(experiment, data, before, run, on_validation))
    run.finish(("model.safetensors",))


def evaluate_run(experiment: Experiment, run: Run, data: PreparedMotion, modes: Sequence[str]) -> None:
    """Evaluate a trained run in the given modes, as one file each. The picture is drawn once."""
    run.attempt("evaluation")
    announce(f"evaluation: measure the errors on the test clips, in {' and '.join(modes)} mode")
    with record_time(run, "evaluate"):
        model = experiment.architecture.load(run.weights()).to(experiment.device)
        test = data.open("test").to(experiment.device)
        for mode in modes:
            settings = select_evaluation_settings(experiment.config, mode, experiment.motion.groups_digest)
            name = experiment.evaluations[mode]
            report = {"mode": mode, "run": run.manifest["id"], "name": name, "settings": settings}
            report["component_versions"] = find_evaluation_versions(settings)
            report |= describe_machine(experiment) | describe_user_code(experiment)
            write_report(run.evaluation(name), report | experiment.evaluation.report(model, test, mode))
        if not run.picture.exists() and find_spec("matplotlib"):
            draw_first_clip(model, test, run.picture)


def draw_first_clip(model: MotionModel, test: MotionDataset, path: Path) -> None:
    """Draw prediction and truth for the start of the first test clip, as a PNG."""
    from memmlp.report.pictures.clip_pictures import ClipPiece, write_picture  # matplotlib takes 0.5 s

    truth, predicted = predict_first_clip(model, test)
    write_picture(path, ClipPiece(test.names[0], truth, {"prediction": predicted}))


def deploy_run(experiment: Experiment, run: Run, data: PreparedMotion) -> None:
    """Export a trained run, compare the file with torch, and time it."""
    run.attempt("deployment")
    announce("deployment: export to ONNX, compare with torch, and time a frame")
    deployment, name = experiment.deployment, experiment.deployment_id
    assert deployment is not None
    assert name is not None
    with record_time(run, "export"):
        model = experiment.architecture.load(run.weights())
        clips = [data.open(part).read_clips() for part in ("train", "test")]
        deployed = run.deployment(name)
        deployed.latency.unlink(missing_ok=True)  # an incomplete deployment is made again from the start
        record = deployment.deploy(model, deployed, run.id, *clips)
        record |= measure_pose_times(deployed.onnx, deployment.latency_steps)
        if (precision := deployment.precision) in record:
            record[precision] |= measure_pose_times(deployed.onnx_path(precision), deployment.latency_steps)
        settings = select_deployment_settings(experiment.config)
        deployed.finish({"run": run.manifest["id"], "settings": settings, **record})


def begin_run(
    experiment: Experiment, run: Run, identity: Identity, config: dict[str, Any], before: Run | None
) -> None:
    """Begin a training: write its config, and record its identity, the machine, and the origin of the
    prerequisite run's weights (`before`) in the manifest."""
    above = identity.prerequisite
    counting: Mapping[str, Any] = {**(above.config if above else {}), **identity.config}
    origin: dict[str, Any] = {}
    if before:
        origin[PREREQUISITES] = list_prerequisite_origins(before.manifest, before.weights_digest)
        origin["prerequisite_tflop"] = before.manifest.get("tflop")
    facts = {
        **origin,
        "component_versions": identity.component_versions,
        **describe_machine(experiment),
        "processes": distributed.world_size(),
        **describe_user_code(experiment),
        "name": experiment.make_name(identity.kind, counting),
        "user": find_user_name(),
    }
    run.begin(identity.kind, config, data=identity.data, prerequisite=above.id if above else None, **facts)


def find_user_name() -> str | None:
    """Return the user's name; None if the system does not know it."""
    with contextlib.suppress(KeyError, OSError, ImportError):
        return getpass.getuser()
    return None


def describe_machine(experiment: Experiment) -> dict[str, Any]:
    """Return the facts that can change the last digits of a result: device, GPU, threads, precision."""
    return {
        **describe_device(experiment.device),
        "threads": torch.get_num_threads(),
        "precision": experiment.training.optim.precision,
    }


@contextlib.contextmanager
def record_time(run: Run, stage: str) -> Iterator[None]:
    """Add a stage's seconds to the seconds of earlier work on that stage."""
    started = time.monotonic()
    yield
    before = run.manifest.get("seconds", {}).get(stage, 0.0)
    run.record_seconds(stage, before + time.monotonic() - started)
