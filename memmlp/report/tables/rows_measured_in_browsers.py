"""Rows of Table 17 that were measured in a browser: the output of `memmlp web`'s bench, read and checked."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError, describe_read_error, escape_line_breaks
from memmlp.report.tables.table import Cell, Effect, Row, Table

FORMAT = "memmlp web bench 1"
NUMBER = 17  # the table's, in the paper
LARGEST = 1_000_000  # bytes of a file
GRAPHS = {"naive": "as published", "streaming": "stream"}
BASE = ("AvatarPoser", "naive", "fp32")
"""The network to which ratios on the page refer: AvatarPoser as published."""
ABOUT = {"device": str, "browser": str, "onnxruntime_web": str, "date": str, "clock_ms": float}
ROW = {
    "network": str, "parameters": float, "graph": str, "precision": str, "backend": str, "threads": float,
    "steps": float, "median_ms": float,
}  # fmt: skip
MAYBE = ("ratio_to_yardstick", "whole_median_ms")
"""Numbers of a row that may be null."""


@dataclass(frozen=True)
class BrowserBench:
    """A file of the bench: the device, the browser, and the rows, each as the page wrote them."""

    about: Mapping[str, Any]
    rows: tuple[Mapping[str, Any], ...]

    @property
    def name(self) -> str:
        """The device and the browser, in words."""
        return f"{self.about['device']}, {self.about['browser']}"


def read(path: Path) -> BrowserBench:
    """Read a file of the bench.

    Raises:
        InputError: if the file can't be read, or is not a file of the bench.
    """
    try:
        content = json.loads(path.read_bytes()[:LARGEST])
        if content["format"] != FORMAT:
            raise ValueError(f"its format is not '{FORMAT}'")
        rows = tuple(
            {name: _check(row, name, kind) for name, kind in ROW.items()}
            | {name: _check(row, name, float, optional=True) for name in MAYBE}
            for row in content["rows"]
        )
        if not rows:
            raise ValueError("it has no rows")
        return BrowserBench({name: _check(content, name, kind) for name, kind in ABOUT.items()}, rows)
    except OSError as error:
        raise InputError(f"--add {path}: {describe_read_error(error)}") from None
    except (ValueError, KeyError, TypeError) as error:
        expected = "expected a file that the bench of a site of memmlp web copies or saves"
        raise InputError(f"--add {path}: {error}; {expected}") from None


def _check(found: Mapping[str, Any], name: str, kind: type, optional: bool = False) -> Any:
    """Return a text that is safe to print on a terminal, or a number above 0."""
    value = found[name]
    if kind is str and isinstance(value, str) and 0 < len(value) <= 300:
        return escape_line_breaks(value)
    if kind is float and type(value) in (int, float) and math.isfinite(value) and value > 0:
        return value
    if optional and value is None:
        return None
    raise ValueError(f"{name}: {str(value)[:60]}: must be a {'text' if kind is str else 'number above 0'}")


def add_rows(table: Table, measured: BrowserBench) -> Table:
    """Return Table 17 with a browser's rows below its own.

    Their differences and ratios compare with AvatarPoser as published, in the same browser on the same
    backend. The column `ratio` compares with the same fixed yardstick as in the other rows.

    Raises:
        InputError: for a table other than Table 17.
    """
    if table.number != NUMBER:
        raise InputError(f"--add: {table.name} is not Table {NUMBER}; expected memmlp table {NUMBER}")
    own = [row for row in measured.rows if (row["network"], row["graph"], row["precision"]) == BASE]
    bases = {row["backend"]: row for row in own}
    rows = [_row(table, measured, row, bases.get(row["backend"])) for row in measured.rows]
    about = measured.about
    threads, steps = (
        " or ".join(map(str, sorted({int(row[key]) for row in measured.rows})))
        for key in ("threads", "steps")
    )
    flag = (
        f"{measured.name}: onnxruntime-web {about['onnxruntime_web']}, "
        f"{threads} thread{'s' * (threads != '1')}, the median of {steps} steps, a clock of "
        f"{about['clock_ms']:.2g} ms, {about['date'][:10]}; an end-to-end pose is by the full graph; "
        "differences are from AvatarPoser as published, there on the same backend"
    )
    return replace(table, rows=(*table.rows, *rows), flags=(*table.flags, flag))


def _row(table: Table, measured: BrowserBench, row: Mapping[str, Any], base: Mapping[str, Any] | None) -> Row:
    other = base if base is not row else None
    costs, others = _costs(row), _costs(other) if other else {}

    def cell(metric: str) -> Cell:
        value, theirs = costs.get(metric), others.get(metric)
        effect = None if value is None or theirs is None else Effect(value - theirs)
        return Cell({} if value is None else {0: value}, effect=effect)

    return Row(
        label=_label(measured, row),
        branch=table.rows[0].branch,
        against=_label(measured, other) if other else None,
        note=None,
        found=(0,),
        wanted=(0,),
        cells={mode: {metric: cell(metric) for metric in table.metrics} for mode in table.modes},
    )


def _label(measured: BrowserBench, row: Mapping[str, Any]) -> str:
    """Name a row, with its network's size, as a site's networks may differ in size from the table's own."""
    graph, size = GRAPHS.get(row["graph"], row["graph"]), row["parameters"] / 1e6
    how = f"{graph}, {row['precision']}, {row['backend']}"
    return f"{row['network']} of {size:.3g} M parameters, {how}: {measured.name}"


def _costs(row: Mapping[str, Any]) -> dict[str, float | None]:
    return {
        "ms": row["median_ms"],
        "pose ms": row["whole_median_ms"],
        "ratio": row["ratio_to_yardstick"],
        "FPS": 1000 / row["median_ms"],
    }
