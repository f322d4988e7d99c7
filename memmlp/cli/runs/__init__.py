"""`memmlp runs`: list, show, compare, tag, stop, clean up and move run folders."""

import click

from memmlp.cli.runs.listing import list_runs
from memmlp.cli.runs.show import diff, show
from memmlp.cli.runs.storage import (
    archive,
    delete,
    export,
    gc,
    import_,
    note,
    prioritize,
    rename,
    restore,
    retry,
    stop,
    tag,
    unprioritize,
)


@click.group("runs")
def runs() -> None:
    """List, show, compare, tag, clean up and move runs."""


for command in (
    list_runs, show, diff, tag, note, rename, stop, retry, prioritize, unprioritize, archive, restore, delete,
    gc, export, import_,
):  # fmt: skip
    runs.add_command(command)
