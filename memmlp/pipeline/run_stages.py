"""Brings an experiment to its end: data, upstream runs, the network's run, its evaluations, its deployment.

Each stage has an identity (memmlp.runs.identity). A stage whose identity exists already is reused; otherwise
it is made.
"""

from __future__ import annotations

import contextlib
import getpass
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from memmlp.common import distributed
from memmlp.common.errors import LeaseLost, TrainingDiverged, of_the_disk
from memmlp.common.files import write_json
from memmlp.common.progress import remark, tell
from memmlp.evaluation.evaluation import predict_first_clip
from memmlp.evaluation.predictions import save_predictions
from memmlp.experiment_tracking.follower_pipe import Loggers
from memmlp.live.pose_latency import measure_pose
from memmlp.motion.dataset import MotionDataset
from memmlp.motion.motion_source import Prepared
from memmlp.networks.motion_model import MotionModel
from memmlp.pipeline.data_remarks import (
    data_remarks,
    data_warnings,
    partial_words,
    tested_clips_remark,
)
from memmlp.pipeline.devices import described, overlooked_gpu
from memmlp.pipeline.experiment import Experiment, UpstreamTraining
from memmlp.runs.environment import computed_imports, packages_of_ones_own
from memmlp.runs.evaluation_file import read_report, write_report
from memmlp.runs.identity import (
    NETWORK,
    Identity,
    deployment_settings,
    evaluation_recipes,
    evaluation_settings,
)
from memmlp.runs.resumed_origin import UPSTREAM
from memmlp.runs.run import Run
from memmlp.runs.upstream_origin import upstream_origins
from memmlp.training.loop import ValidationCallback


@dataclass(frozen=True)
class Outcome:
    """The result of an experiment.

    Attributes:
        run: the network's run.
        made: the stages that this call made, out of "training", "evaluation" and "deployment".
        results: mode -> branch -> metric, and "latency".
        stage_ids: the identities of the evaluations and the deployment that the results come from.
    """

    run: Run
    made: tuple[str, ...]
    results: dict[str, Any]
    stage_ids: tuple[str, ...]


def run_experiment(experiment: Experiment, on_validation: ValidationCallback | None = None) -> Outcome:
    """Bring the experiment's run to its end, doing only what is missing.

    Args:
        experiment: what to run.
        watch: called after each validation with the step and its values; it may raise to stop the run.
    """
    data = experiment.motion.prepare()
    clips = data.manifest.clips
    tell(f"data: {len(clips)} clips ({tested_clips_remark(clips)}), prepared in {data.cache}")
    for said in data_remarks(data):
        remark(f"data: {said}")
    run = Run.of(experiment.outputs, experiment.identity(data.digest).id)
    if not run.done:
        if experiment.evaluations:
            data.open("test")  # an error without test clips, which is better told now than after the training
        experiment.training.optim.check_installed()
        if overlooked := overlooked_gpu(experiment.config["device"]):
            remark(overlooked)
    upstream = None if run.done and not experiment.force else make_upstream_runs(experiment, data)
    with run.lock():
        if experiment.force:
            run.reset()
        made = []
        with recording_outcome(experiment, run):
            if not run.done:
                # Another process may have begun the run anew since it was seen to be done.
                train_run(
                    experiment, run, data, upstream or make_upstream_runs(experiment, data), on_validation
                )
                made.append("training")
            made += make_missing_stages(experiment, run, data)
        if experiment.predictions is not None:
            model = experiment.architecture.load(run.weights()).to(experiment.device)
            test = data.open("test").to(experiment.device)
            save_predictions(experiment.evaluation, model, test, experiment.predictions)
    return Outcome(run, tuple(made), results_of(experiment, run), experiment.stage_ids)


def complete_stages(
    experiment: Experiment, run: Run, data: Prepared, again: bool = False
) -> tuple[dict[str, Any], list[str]]:
    """Make the missing evaluations and deployment of a trained run, and return its results.

    Args:
        experiment: says which evaluations and deployment.
        run: the trained run.
        data: the prepared motion.
        again: whether to repeat evaluations that were made before.

    Returns:
        The results, and the names of the stages that were made.
    """
    with run.lock(), recording_outcome(experiment, run, again):
        if again:
            evaluate_run(experiment, run, data, experiment.evaluation.modes)
        made = [*(["evaluation"] if again else []), *make_missing_stages(experiment, run, data)]
    return results_of(experiment, run), made


def make_missing_stages(experiment: Experiment, run: Run, data: Prepared) -> list[str]:
    """Make the missing evaluations and deployment of a trained run.

    Returns:
        The names of the stages that were made.
    """
    made = []
    facts = data_warnings(experiment, data)
    if not facts.keys() <= run.manifest.keys():  # a run from before these were recorded
        run.write_manifest(facts)
    run.want(experiment.stage_ids)
    if missing := unmeasured(experiment, run):
        if any(run.has(experiment.evaluations[mode]) for mode in missing):
            tell("evaluation: code of the metrics' packages has changed since they were measured")
        evaluate_run(experiment, run, data, missing)
        made.append("evaluation")
    for name in experiment.deployments:
        if not run.has(name):
            deploy_run(experiment, run, data, name)
            made.append("deployment")
    return made


def unmeasured(experiment: Experiment, run: Run) -> list[str]:
    """Return the modes that have no evaluation, or one by other code of the user's own metrics than today's.

    What a package computes may change without a new recipe; then its metrics are measured again.
    """
    return [
        mode
        for mode, name in experiment.evaluations.items()
        if not run.has(name) or _measured_by_other_code(experiment, read_report(run.evaluation(name)))
    ]


def _measured_by_other_code(experiment: Experiment, report: Mapping[str, Any]) -> bool:
    """Return whether a report has metrics of the user's own by code of packages that has changed since."""
    if not (report.get("settings") or {}).get("metrics"):
        return False
    before, now = report.get("plugins") or {}, own_code(experiment).get("plugins", {})
    return any(before[name]["digest"] != now[name]["digest"] for name in before.keys() & now.keys())


def results_of(experiment: Experiment, run: Run) -> dict[str, Any]:
    """Return the results that the experiment asks for: mode -> branch -> metric, and "latency"."""
    files = {mode: run.evaluation(name) for mode, name in experiment.evaluations.items() if run.has(name)}
    means = {mode: read_report(path)["mean"] for mode, path in files.items()}
    records = [run.deployment(name).record for name in experiment.deployments]
    return means | ({"latency": records[0]} if any(records) else {})


def clip_rows(experiment: Experiment, run: Run) -> list[dict[str, Any]]:
    """Return name, frames and the wanted metrics, by mode and branch, for each test clip."""
    rows: dict[str, dict[str, Any]] = {}
    for mode, name in experiment.evaluations.items():
        for clip in read_report(run.evaluation(name))["clips"]:
            facts = {key: value for key, value in clip.items() if not isinstance(value, dict)}
            branches = {key: value for key, value in clip.items() if isinstance(value, dict)}
            rows.setdefault(clip["name"], facts)[mode] = branches
    return list(rows.values())


def make_upstream_runs(experiment: Experiment, data: Prepared, last: str | None = None) -> Run | None:
    """Train what is missing of the runs upstream, in order, and return the last of them; None for none.

    Args:
        experiment: the experiment.
        data: the prepared motion.
        last: the id of the run upstream that is wanted; by default the last one.
    """
    if experiment.unrefined:
        return run_experiment(experiment.unrefined).run
    run: Run | None = None
    identities = experiment.upstream_identities(data.digest)
    for training, identity in zip(experiment.upstream, identities, strict=True):
        run = find_or_train_upstream(experiment, training, identity, data, run)
        if run.id == last:
            break
    return run


def find_or_train_upstream(
    experiment: Experiment,
    training: UpstreamTraining,
    identity: Identity,
    data: Prepared,
    upstream: Run | None,
) -> Run:
    """Return the finished upstream run with that identity, training it if necessary."""
    run = Run.of(experiment.outputs, identity.id)
    with run.lock():
        if run.done:
            return run
        with recording_outcome(experiment, run):
            train_upstream(experiment, training, identity, data, run, upstream)
    return run


def train_upstream(
    experiment: Experiment,
    training: UpstreamTraining,
    identity: Identity,
    data: Prepared,
    run: Run,
    upstream: Run | None,
) -> None:
    """Train a run that other runs build upon, and mark it as done."""
    begin(experiment, run, identity, training.config, upstream)
    run.write_manifest({"partial": partial_words(experiment, data)})
    tell(f"{training.description} (run {run.id})")
    weights = upstream.weights() if upstream else None
    distributed.broadcast(training.kind)  # tells the others what is trained now
    errors = training.train(experiment.architecture, data, weights, run, experiment.device)
    write_json(run.results_path, {"val": errors})
    run.finish(("model.safetensors", "results.json"))


@contextlib.contextmanager
def recording_outcome(experiment: Experiment, run: Run, again: bool = False) -> Iterator[None]:
    """Follow work on a run in the loggers, and record in the run's folder how it ended.

    Only failures of the work itself are recorded. Bad input, interruptions, a full disk, a closed output
    pipe, and the loss of the run to another process are not.
    """
    missing = again or not run.done or not all(map(run.has, experiment.stage_ids))
    missing = missing or bool(unmeasured(experiment, run))
    loggers = experiment.loggers if missing else Loggers((), experiment.outputs)
    with loggers.following(run):
        try:
            yield
        except (LeaseLost, BrokenPipeError):
            raise
        except TrainingDiverged as error:
            run.fail(str(error))
            raise
        except (RuntimeError, OSError) as error:
            if not of_the_disk(error):
                run.fail(f"{type(error).__name__}: {error}", traceback.format_exc())
            raise
        run.forgive()


def train_run(
    experiment: Experiment,
    run: Run,
    data: Prepared,
    upstream: Run | None,
    on_validation: ValidationCallback | None = None,
) -> None:
    """Train the network of a run, and mark the run as done."""
    steps = experiment.training.optim.steps
    tell(f"network: train it for {steps} steps (run {run.id})")
    begin(experiment, run, experiment.identity(data.digest), experiment.config, upstream)
    if files := computed_imports(run.manifest.get("plugins") or {}):
        remark(f"plugins: edits are not seen of what is imported by computed names ({files})")
    run.write_manifest({"body": data.manifest.body, **data_warnings(experiment, data)})
    run.want(experiment.stage_ids)
    run.clear_stages()
    weights = upstream.weights() if upstream else None
    distributed.broadcast(NETWORK)  # tells the others what is trained now
    experiment.training.train(experiment.architecture, data, weights, run, experiment.device, on_validation)
    run.finish(("model.safetensors",))


def evaluate_run(experiment: Experiment, run: Run, data: Prepared, modes: Sequence[str]) -> None:
    """Evaluate a trained run in the given modes.

    Each evaluation is one file, which is written completely or not at all. A picture is drawn, too, once.
    """
    run.attempt("evaluation")
    tell(f"evaluation: measure the errors on the test clips, in {' and '.join(modes)} mode")
    with timed(run, "evaluate"):
        model = experiment.architecture.load(run.weights()).to(experiment.device)
        test = data.open("test").to(experiment.device)
        for mode in modes:
            settings = evaluation_settings(experiment.config, mode, experiment.motion.groups_digest)
            name = experiment.evaluations[mode]
            report = {"mode": mode, "run": run.manifest["id"], "name": name, "settings": settings}
            report |= {"recipes": evaluation_recipes(settings), **machine(experiment), **own_code(experiment)}
            write_report(run.evaluation(name), report | experiment.evaluation.report(model, test, mode))
        if not run.picture.exists() and find_spec("matplotlib"):
            draw_first_clip(model, test, run.picture)


def draw_first_clip(model: MotionModel, test: MotionDataset, path: Path) -> None:
    """Draw the start of the first test clip beside the truth, as a PNG."""
    from memmlp.report.pictures.clip_pictures import write_picture  # matplotlib takes 0.5 s to import
    from memmlp.report.pictures.clip_piece import ClipPiece

    truth, predicted = predict_first_clip(model, test)
    write_picture(path, ClipPiece(test.names[0], truth, {"prediction": predicted}))


def deploy_run(experiment: Experiment, run: Run, data: Prepared, name: str) -> None:
    """Make the deployment with that identity: export a trained run, check the file against torch, time it."""
    run.attempt("deployment")
    tell("deployment: export to ONNX, compare with torch, and time a frame")
    with timed(run, "export"):
        model = experiment.architecture.load(run.weights())
        clips = [data.open(part).clips() for part in ("train", "test")]
        deployed = run.deployment(name)
        deployed.latency.unlink(missing_ok=True)  # it lacks a file and is made again, from the start
        deployment = experiment.deployments[name]
        record = deployment.deploy(model, deployed, run.id, *clips)
        record |= measure_pose(deployed.onnx, deployment.latency_steps)
        if (precision := deployment.precision) in record:
            record[precision] |= measure_pose(deployed.file(precision), deployment.latency_steps)
        deployed.finish(
            {"run": run.manifest["id"], "settings": deployment_settings(experiment.config), **record}
        )


def begin(
    experiment: Experiment, run: Run, identity: Identity, config: dict[str, Any], upstream: Run | None
) -> None:
    """Begin a training: write its config, and record in the manifest its identity and the machine.

    The manifest also has the weights that the training builds upon, and what these were made by.
    """
    above = identity.upstream.id if identity.upstream else None
    facts: dict[str, Any] = {UPSTREAM: upstream_origins(upstream)} if upstream else {}
    facts |= {"recipes": identity.recipes, "what": identity.what, **machine(experiment)}
    facts |= {"processes": distributed.size(), **own_code(experiment)}
    counting = {**(identity.upstream.config if identity.upstream else {}), **identity.config}
    facts |= {"name": experiment.called(identity.kind, counting), "user": user()}
    run.begin(identity.kind, config, data=identity.data, upstream=above, **facts)


def user() -> str | None:
    """Return the user's name, if the system knows it."""
    with contextlib.suppress(KeyError, OSError, ImportError):
        return getpass.getuser()
    return None


def own_code(experiment: Experiment) -> dict[str, Any]:
    """Return version and digest of the user's own packages in the experiment; empty if it uses none."""
    packages = experiment.config.get("plugins")
    return {"plugins": packages_of_ones_own(packages)} if packages else {}


def machine(experiment: Experiment) -> dict[str, Any]:
    """Return the facts that can change the last digits of a result: device, GPU, threads, precision."""
    return {
        **described(experiment.device),
        "threads": torch.get_num_threads(),
        "precision": experiment.training.optim.precision,
    }


@contextlib.contextmanager
def timed(run: Run, stage: str) -> Iterator[None]:
    """Add the seconds that a stage takes to those of earlier work on it, in other modes or precisions."""
    started = time.monotonic()
    yield
    before = run.manifest.get("seconds", {}).get(stage, 0.0)
    run.took(stage, before + time.monotonic() - started)
