"""`memmlp report`: the page of `memmlp ui` as one HTML file."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import click

from memmlp.cli.options import HomePath, outputs_option, plugins_option


@click.command("report")
@click.argument("sweeps", nargs=-1)
@click.option(
    "--out",
    type=HomePath(dir_okay=False),
    help="HTML file to write.  [default: report.html in --outputs]",
)
@click.option("--no-replays", is_flag=True, help="Write a smaller file, without 3D replays of clips.")
@plugins_option
@outputs_option
def report(sweeps: tuple[str, ...], out: Path | None, no_replays: bool, outputs: Path) -> None:
    """Write the page of `memmlp ui` as one file, which works offline.

    SWEEPS are sweep files, numbers of the paper's tables, or folders in outputs/sweeps. The default is all
    sweeps. The file contains the runs and tables of these sweeps, and all searches.
    """
    from memmlp.cli.table import write
    from memmlp.cli.ui import predict
    from memmlp.report.ui.report_file import write_page
    from memmlp.report.ui.server import Answers
    from memmlp.runs.environment import describe_environment

    facts = describe_environment()
    git = facts["git"] or {}
    code = f"{git.get('commit', facts['version'])[:7]}{' with changes' if git.get('dirty') else ''}"
    about = datetime.now(UTC).strftime(f"Generated %Y-%m-%d %H:%M UTC, code {code}")
    answers = Answers(outputs, predict)
    try:
        text = write_page(answers, sweeps, about, not no_replays)
    finally:
        answers.close()
    write(out or outputs / "report.html", text)
