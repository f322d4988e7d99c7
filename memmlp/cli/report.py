"""`memmlp report`: the page of sweeps, their runs, tables and figures as one HTML file."""

from __future__ import annotations

import functools
from datetime import UTC, datetime
from pathlib import Path

import click

from memmlp.cli.options import config_dir_option, outputs_option, plugins_option

DEFAULT = ["all", "memory_control"]


@click.command("report")
@click.argument("words", nargs=-1, metavar="[NAMES]... [OVERRIDES]...")
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    help="HTML file to write.  [default: report.html in --outputs]",
)
@click.option("--no-replays", is_flag=True, help="Leave out the worst seconds of the best runs in 3D.")
@config_dir_option
@plugins_option
@outputs_option
def report(words: tuple[str, ...], out: Path | None, no_replays: bool, outputs: Path) -> None:
    """Write the page of `memmlp ui` about some sweeps as one file, which needs neither server nor network.

    NAMES are those of `memmlp table`; without any, the file has all tables of the paper and the memory's
    controls. OVERRIDES are those of the sweeps' runs. The file also has all searches below --outputs.
    """
    from memmlp.cli.table import SHOWN_MODES, gathered, write
    from memmlp.cli.ui import predict
    from memmlp.config.compose_plan import sweep_folder
    from memmlp.report.tables.measured_run import load
    from memmlp.report.ui.report_file import ReportedSweep, write_page
    from memmlp.report.ui.server import Answers
    from memmlp.runs.environment import environment

    names = [word for word in words if "=" not in word and not word.startswith("~")]
    overrides = [word for word in words if word not in names]
    found = gathered(names or DEFAULT, overrides, outputs, SHOWN_MODES["both"], functools.cache(load))
    sweeps = [
        ReportedSweep(sweep_folder(sweep, outputs).name, sweep, runs, table) for sweep, runs, table in found
    ]
    facts = environment()
    git = facts["git"] or {}
    code = f"{git.get('commit', facts['version'])[:7]}{' with changes' if git.get('dirty') else ''}"
    about = datetime.now(UTC).strftime(f"Generated %Y-%m-%d %H:%M UTC, code {code}")
    answers = Answers(outputs, predict)
    try:
        text = write_page(answers, sweeps, about, not no_replays)
    finally:
        answers.close()
    write(out or outputs / "report.html", text)
