"""What every command says of the runs whose networks it shows: that one is hardly trained, for example."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from memmlp.runs.run import Run


def remark_on(runs: Iterable[Run]) -> None:
    """Say on standard error which of the runs' networks hardly saw motion in training."""
    from memmlp.runs.lookup import frames_seen, hardly_trained

    for run in runs:
        if said := hardly_trained(frames_seen(run)):
            click.echo(f"run {run.id}: {said}", err=True)
