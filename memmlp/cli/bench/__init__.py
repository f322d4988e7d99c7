"""`memmlp bench`: measurements on this machine of speed, and of sweeps under kills."""

from __future__ import annotations

import click

from memmlp.cli.bench.chaos import chaos, chaos_tune
from memmlp.cli.bench.latency import latency
from memmlp.cli.bench.live_frame import live_frame
from memmlp.cli.bench.loggers import loggers
from memmlp.cli.bench.prepare_data import prepare
from memmlp.cli.bench.soak import soak
from memmlp.cli.bench.stream_evaluation import stream
from memmlp.cli.bench.time_to_error import train
from memmlp.cli.bench.ui_page import ui


@click.group("bench")
def bench() -> None:
    """Measure this machine: speed as rates and ratios within one run, sweeps under kills, pages."""


for command in (
    prepare, stream, train, latency, live_frame, soak, loggers, chaos, chaos_tune, ui,
):  # fmt: skip
    bench.add_command(command)
