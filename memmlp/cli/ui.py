"""The page of all runs: `memmlp ui` serves it, `memmlp report` writes it as one file."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import HomePath, add_page_options, add_run_options
from memmlp.cli.table import write
from memmlp.common.errors import InputError
from memmlp.common.page_server import check_token
from memmlp.common.text_formats import join_command
from memmlp.runs.environment import describe_environment
from memmlp.runs.identity import NETWORK
from memmlp.runs.run import Run

if TYPE_CHECKING:
    import numpy as np


@click.command("ui")
@add_page_options(port=8787)
@add_run_options
def ui(port: int, host: str, token: str | None, no_browser: bool, outputs: Path) -> None:
    """Show runs, sweeps and searches on a local web page, with live updates.

    Its buttons change runs like `memmlp runs`. Ctrl-C stops the server. docs/guides/ui.md describes the page.
    """
    import webbrowser

    from memmlp.report.ui.server import Answers, RunsServer

    check_token(host, token)
    with (
        RunsServer(Answers(outputs, predict, make_command=make_command), port, host, token) as server,
        contextlib.suppress(KeyboardInterrupt),
    ):
        click.echo(f"{server.url}  runs in {outputs / 'runs'}; Ctrl-C ends")
        if not no_browser:
            webbrowser.open(server.url)
        threading.Event().wait()


def make_command(run: Run) -> str:
    """Return the command that trains a network's run again."""
    from memmlp.config.build import list_overrides

    if run.manifest.get("kind") != NETWORK:
        raise InputError(f"run {run.id}: has the command of the runs that need it")
    with _compose_lock:
        return join_command(["memmlp", "train", *list_overrides(run.config)])


_compose_lock = threading.Lock()  # Hydra composes one config at a time


def predict(run: Run, clip: str, mode: str) -> Mapping[str, np.ndarray]:
    """Return a run's prediction for a test clip (`make_prediction_arrays`), computed on one CPU thread."""
    import torch

    from memmlp.config.open_run import find_clip, open_existing_run
    from memmlp.evaluation.predictions import predict_clip

    torch.set_num_threads(1)  # leaves the other threads to training processes
    with _compose_lock:
        opened = open_existing_run(run)
    if opened.experiment.motion.find_digest() is None:
        raise InputError(f"run {run.id}: its data is not prepared here; prepare it with memmlp eval {run.id}")
    with torch.inference_mode():
        return predict_clip(opened.network(), find_clip(opened.test, clip, "clip"), mode)


@click.command("report")
@click.argument("sweeps", nargs=-1)
@click.option("--out", type=HomePath(dir_okay=False), help="HTML file.  [default: report.html in --outputs]")
@click.option("--no-replays", is_flag=True, help="Write a smaller file, without 3D replays of clips.")
@add_run_options
def report(sweeps: tuple[str, ...], out: Path | None, no_replays: bool, outputs: Path) -> None:
    """Write the page of `memmlp ui` as one file, which works offline.

    SWEEPS are sweep files, numbers of the paper's tables, or folders in outputs/sweeps. The default is all
    sweeps. The file contains the runs and tables of these sweeps, and all searches.
    """
    from memmlp.report.ui.report_file import write_page
    from memmlp.report.ui.server import Answers

    facts = describe_environment()
    git = facts["git"] or {}
    code = f"{git.get('commit', facts['version'])[:7]}{' with changes' if git.get('dirty') else ''}"
    about = datetime.now(UTC).strftime(f"Generated %Y-%m-%d %H:%M UTC, code {code}")
    with contextlib.closing(Answers(outputs, predict)) as answers:
        text = write_page(answers, sweeps, about, not no_replays)
    write(out or outputs / "report.html", text)
