"""`memmlp predict`: a finished run's predictions for clips, as files for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import (
    PATH,
    add_run_options,
    check_runs_exist,
    device_option,
    format_option,
    strict_option,
    warn_about_training,
)
from memmlp.common.errors import InputError

if TYPE_CHECKING:
    from memmlp.config.open_run import OpenedRun
    from memmlp.evaluation.modes import Evaluation
    from memmlp.evaluation.predictions import ClipPredictor
    from memmlp.motion.exporting import ExportReport


@click.command("predict")
@click.argument("run")
@click.argument("source")
@click.option("--out", required=True, type=PATH, help="File to write, or folder if SOURCE is a folder.")
@format_option
@click.option("--mode", default="stream", type=click.Choice(["stream", "window"]))
@click.option(
    "--ik",
    type=click.Choice(["off", "lbfgs", "arms"]),
    help="Inverse kinematics to apply.  [default: the run's evaluation.ik]",
)
@click.option(
    "--branch", type=click.Choice(["rotation", "combined", "truth"]),
    help="Motion to write. rotation: the network's rotations; combined: these rotations after inverse "
    "kinematics; truth: the true motion.  [default: combined; rotation if inverse kinematics is off]",
)  # fmt: skip
@strict_option
@device_option
@add_run_options
def predict(
    run: str,
    source: str,
    out: Path,
    format_: str | None,
    mode: str,
    ik: str | None,
    branch: str | None,
    strict: bool,
    device: str,
    outputs: Path,
) -> None:
    """Write the predictions of a finished RUN (id, beginning of an id, folder, or shipped network) for clips.

    SOURCE is an AMASS npz file, a folder of npz files, or the name of a test clip. Predictions are at 60 Hz,
    on the body that the network was trained with. They start at the clip's second frame.
    """
    check_runs_exist(outputs, run)
    from memmlp.cli.data.printing import show_exported
    from memmlp.config.open_run import open_run
    from memmlp.evaluation.predictions import ClipPredictor
    from memmlp.motion.body import check_imported_body
    from memmlp.motion.exporting import plan_export

    opened = open_run(outputs, run, device, [] if ik is None else [f"evaluation.ik={ik}"])
    evaluation, clips = opened.experiment.evaluation, opened.experiment.motion.clips
    chosen = choose_branch(evaluation, branch)
    predictor = ClipPredictor(opened.network(), mode, chosen, evaluation, clips.interpolation)
    if Path(source).exists():
        plan = plan_export(Path(source), out, format_)
        check_imported_body([target.source for target in plan.targets], predictor.rest, "the network")
        report = predictor.export(plan, strict=strict)
    else:
        report = predict_test_clip(predictor, opened, source, out, format_)
    click.echo(f"run {opened.run.id}: {chosen}, {mode} mode")
    show_exported(report, out)
    warn_about_training(opened.run)


def choose_branch(evaluation: Evaluation, branch: str | None) -> str:
    """Return the branch of --branch; by default combined if inverse kinematics is on, otherwise rotation."""
    from memmlp.evaluation.ik import NoIK

    solved = not isinstance(evaluation.ik, NoIK)
    if branch == "combined" and not solved:
        raise InputError("--branch combined: needs --ik lbfgs or arms")
    return branch or ("combined" if solved else "rotation")


def predict_test_clip(
    predictor: ClipPredictor, run: OpenedRun, name: str, out: Path, format_: str | None
) -> ExportReport:
    from memmlp.motion.body import FPS
    from memmlp.motion.exporting import ExportReport, choose_format, write_motion

    chosen, test = choose_format(out, format_, folder=False), run.test
    if name not in test.names:
        names = ", ".join(test.names)
        raise InputError(f"SOURCE {name}: must be a file, a folder, or a test clip of the run: {names}")
    (clip,) = predictor.predict([name], [test.read_clip(test.names.index(name))])
    write_motion(out, clip, predictor.rest, chosen)
    return ExportReport((out,), len(clip) / FPS, ())
