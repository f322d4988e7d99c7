"""`memmlp runs`: list, show, compare, tag, stop, clean up and move run folders."""

import click

from memmlp.cli.runs import listing, show, storage


@click.group("runs")
def runs() -> None:
    """List, show, compare, tag, clean up and move runs."""


for module in (listing, show, storage):
    for command in vars(module).values():
        if isinstance(command, click.Command):
            runs.add_command(command)
