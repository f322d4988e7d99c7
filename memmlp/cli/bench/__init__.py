"""`memmlp bench`: measurements of speed on this machine."""

from __future__ import annotations

import click

from memmlp.cli.bench.latency import latency, live_frame
from memmlp.cli.bench.train import train


@click.group("bench")
def bench() -> None:
    """Measure speed on this machine: rates, and ratios within one process."""


for command in (latency, live_frame, train):
    bench.add_command(command)
