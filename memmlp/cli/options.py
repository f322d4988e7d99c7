"""Options that several commands share."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click


class Finite(click.FloatRange):
    """A finite number in a range."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number; click takes NaN and infinity for some."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is no finite number", param, ctx)
        return number


outputs_option = click.option(
    "--outputs",
    type=click.Path(path_type=Path),
    default=Path("outputs"),
    envvar="MEMMLP_OUTPUTS",
    show_default=True,
    help="Folder of runs and caches.",
)
