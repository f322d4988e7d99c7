"""`memmlp ui`: a local web page of runs, sweeps and searches."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import add_page_options, host_option, outputs_option, plugins_option, token_option

if TYPE_CHECKING:
    import numpy as np

    from memmlp.runs.run import Run


@click.command("ui")
@add_page_options(port=8787)
@host_option
@token_option
@plugins_option
@outputs_option
def ui(port: int, host: str, token: str | None, no_browser: bool, outputs: Path) -> None:
    """Show runs, sweeps and searches on a local web page, with live updates.

    The page never changes a run. Ctrl-C stops the server. docs/guides/ui.md describes the page.
    """
    import webbrowser

    from memmlp.common.page_server import check_token
    from memmlp.report.ui.server import Answers, RunsServer

    check_token(host, token)
    with (
        RunsServer(Answers(outputs, predict), port, host, token) as server,
        contextlib.suppress(KeyboardInterrupt),
    ):
        click.echo(f"{server.url}  runs in {outputs / 'runs'}; Ctrl-C ends")
        if not no_browser:
            webbrowser.open(server.url)
        threading.Event().wait()


def predict(run: Run, clip: str, mode: str) -> Mapping[str, np.ndarray]:
    """Return a run's prediction for a test clip (`make_prediction_arrays`), computed on one CPU thread.

    Raises:
        InputError: if the run's data is not prepared on this machine, or does not contain the clip.
    """
    import torch

    from memmlp.common.errors import InputError
    from memmlp.config.open_run import OpenedRun, build_run_experiment, find_clip, load_run_data
    from memmlp.evaluation.predictions import predict_clip

    torch.set_num_threads(1)  # leaves the other threads to training processes
    experiment = build_run_experiment(run)
    if experiment.motion.find_digest() is None:
        raise InputError(f"run {run.id}: its data is not prepared here; prepare it with memmlp eval {run.id}")
    opened = OpenedRun(run, experiment, load_run_data(run, experiment))
    with torch.inference_mode():
        return predict_clip(opened.network(), find_clip(opened.test, clip, "clip"), mode)
