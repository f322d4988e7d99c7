"""`memmlp data`: make, import, verify, prepare, inspect and export motion."""

from __future__ import annotations

import click

from memmlp.cli.data.export import export
from memmlp.cli.data.import_ import import_
from memmlp.cli.data.inspect import inspect
from memmlp.cli.data.prepare import prepare
from memmlp.cli.data.show import show
from memmlp.cli.data.skeleton import skeleton
from memmlp.cli.data.synth import synth
from memmlp.cli.data.verify import verify


@click.group("data")
def data() -> None:
    """Make, import, look at, prepare and export motion data."""


for command in (synth, import_, skeleton, verify, show, prepare, inspect, export):
    data.add_command(command)
