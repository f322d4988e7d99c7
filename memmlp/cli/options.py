"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path

import click

outputs_option = click.option(
    "--outputs",
    type=click.Path(path_type=Path),
    default=Path("outputs"),
    envvar="MEMMLP_OUTPUTS",
    show_default=True,
    help="Folder of runs and caches.",
)
