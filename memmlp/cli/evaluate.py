"""`memmlp eval` and `memmlp import-weights`: the metrics of networks that are not trained here and now."""

from pathlib import Path

import click

from memmlp.cli.options import PATH, add_run_options, device_option, overrides_argument
from memmlp.common.errors import InputError
from memmlp.common.files import write_json
from memmlp.common.text_formats import make_console, make_override
from memmlp.runs.lookup import copy_shipped, find_run, find_shipped


@click.command("eval")
@click.argument("run")
@overrides_argument
@click.option(
    "--save-predictions",
    type=PATH,
    help="Folder for the true and predicted motion, with one npz file per test clip.",
)
@click.option("--json", "json_path", type=PATH, help="JSON file to write: mean metrics, and a row per clip.")
@click.option("--again", is_flag=True, help="Repeat existing measurements.")
@device_option
@add_run_options
def evaluate(
    run: str,
    overrides: tuple[str, ...],
    save_predictions: Path | None,
    json_path: Path | None,
    again: bool,
    device: str,
    outputs: Path,
) -> None:
    """Show the metrics of a finished run on its test clips.

    RUN is an id, the beginning of an id, a folder, or a shipped network (memmlp models). OVERRIDES are keys
    of the evaluation or the export, such as evaluation.ik=lbfgs, evaluation.modes=[stream] or
    export.precision=int8. Missing results are measured without training. To measure a shipped network, set
    data.root to the folder of its data.
    """
    found = find_run(outputs, run)
    if json_path is not None and not json_path.absolute().parent.is_dir():
        raise InputError(f"--json {json_path}: must be a file in an existing folder")
    if save_predictions is not None and save_predictions.exists() and not save_predictions.is_dir():
        raise InputError(f"--save-predictions {save_predictions}: must be a folder, not a file")
    from memmlp.cli.train_summary import list_run_warnings, make_all_metrics_tables
    from memmlp.config.open_run import open_run
    from memmlp.evaluation.predictions import save_predictions as write_predictions
    from memmlp.motion.motion_source import PreparedMotion
    from memmlp.training.request import read_clip_rows, read_results
    from memmlp.training.run_stages import complete_stages

    if find_shipped(run):
        run = str(copy_shipped(found, outputs).folder)
    opened = open_run(outputs, run, device, overrides)
    experiment = opened.experiment
    if isinstance(opened.data, PreparedMotion):
        results, stages = complete_stages(experiment, opened.run, opened.data, again=again)
    elif again or not all(map(opened.run.has, experiment.stage_ids)):
        raise InputError(f"{found.id}: measuring needs its data; set data.root=FOLDER (memmlp models)")
    else:
        results, stages = read_results(experiment, opened.run), []
    outcome = f"{' and '.join(stages)} done" if stages else "measured before"
    click.echo(f"run {opened.run.id}: {outcome}")
    facts = [opened.run.manifest.get(fact) for fact in ("resampled", "unusual")]
    for line in (*filter(None, facts), *list_run_warnings(opened.run)):
        click.echo(line)
    for table in make_all_metrics_tables(opened.run, results, experiment.stage_ids):
        make_console().print(table)
    if json_path is not None:
        write_json(json_path, {"mean": results, "clips": read_clip_rows(experiment, opened.run)})
    if save_predictions is not None:
        write_predictions(experiment.evaluation, opened.network(), opened.test, save_predictions)
        click.echo(f"predictions of {len(opened.test.names)} clips in {save_predictions}")


@click.command("import-weights")
@click.argument("model")
@click.argument("checkpoint", type=PATH)
@overrides_argument
@click.option("--mean", type=PATH, help="File with the mean of the rotations, if the network needs it.")
@click.option("--std", type=PATH, help="File with the standard deviation of the rotations; needs --mean.")
@click.option("--refiner", type=PATH, help="File with the weights of SAGE-Net's refiner.")
@add_run_options
def import_weights(
    model: str,
    checkpoint: Path,
    overrides: tuple[str, ...],
    mean: Path | None,
    std: Path | None,
    refiner: Path | None,
    outputs: Path,
) -> None:
    """Make a finished run from weights that a network's authors publish.

    MODEL is the network, such as avatar_poser, and CHECKPOINT the authors' file. OVERRIDES are those of
    memmlp train, such as data=amass_s1. The run is evaluated, exported and timed.
    """
    if (mean is None) != (std is None):
        raise InputError("--mean: must be given together with --std")
    from memmlp.cli.train_summary import show
    from memmlp.config.open_run import import_weights as run_import

    words = [*overrides, make_override("paths.outputs", str(outputs.absolute()))]
    show(run_import(model, checkpoint, words, [mean, std] if mean and std else [], refiner))
