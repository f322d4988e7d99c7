"""`memmlp runs`: list, show, compare, tag, clean up and move run folders."""

import click

from memmlp.cli.runs.listing import list_runs
from memmlp.cli.runs.show import diff, show
from memmlp.cli.runs.storage import export, gc, import_, note, tag


@click.group("runs")
def runs() -> None:
    """List, show, compare, tag, clean up and move runs."""


for command in (list_runs, show, diff, tag, note, gc, export, import_):
    runs.add_command(command)
