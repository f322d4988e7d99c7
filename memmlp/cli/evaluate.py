"""`memmlp eval`: the metrics of a finished run again, and its predictions as files."""

from __future__ import annotations

import json
from pathlib import Path

import click

from memmlp.cli.options import outputs_option


@click.command("eval")
@click.argument("run")
@click.option("--save-predictions", type=click.Path(path_type=Path), help="Folder for one npz a test clip.")
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="Write per-clip values here.")
@click.option("--device", default="auto", type=click.Choice(["auto", "cpu", "cuda"]), show_default=True)
@outputs_option
def evaluate(
    run: str, save_predictions: Path | None, json_path: Path | None, device: str, outputs: Path
) -> None:
    """Evaluate a finished run (id, its beginning, or folder) on its test clips in its modes."""
    from dataclasses import replace

    from rich.console import Console

    from memmlp import evaluation, pipeline
    from memmlp.cli.opened import opened
    from memmlp.cli.report import metrics_table
    from memmlp.files import write_json

    _, experiment, cache, _ = found = opened(outputs, run, device)
    model = experiment.architecture.load(found.run).to(experiment.device)
    frames = found.test
    modes, batch = experiment.modes, experiment.evaluation_batch
    results = evaluation.evaluate(model, frames, modes, batch, experiment.ik)
    Console(highlight=False).print(metrics_table(results["mean"]))
    if json_path is not None:
        write_json(json_path, json.loads(json.dumps(results)))
    if save_predictions is not None:
        pipeline.save_predictions(replace(experiment, save_predictions=save_predictions), model, cache)
        click.echo(f"predictions of {len(frames.names)} clips under {save_predictions}")
