"""Rows of Table 17 from a browser: reads and checks the output of the bench page of `memmlp web`."""

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
TABLE_NUMBER = 17  # table number in the paper
MAX_BYTES = 1_000_000  # maximum file size
GRAPHS = {"naive": "as published", "streaming": "stream"}
BASE_NETWORK = ("AvatarPoser", "naive", "fp32")
"""The reference for differences and ratios: AvatarPoser as published."""
FILE_FIELDS = {"device": str, "browser": str, "onnxruntime_web": str, "date": str, "clock_ms": float}
ROW_FIELDS = {
    "network": str, "parameters": float, "graph": str, "precision": str, "backend": str, "threads": float,
    "steps": float, "median_ms": float,
}  # fmt: skip
OPTIONAL_ROW_FIELDS = ("ratio_to_yardstick", "whole_median_ms")
"""Numbers in a row that may be null."""


@dataclass(frozen=True)
class BrowserBench:
    """The checked content of a bench file.

    Attributes:
        about: the device, the browser and other facts (FILE_FIELDS).
        rows: the measurements (ROW_FIELDS).
    """

    about: Mapping[str, Any]
    rows: tuple[Mapping[str, Any], ...]

    @property
    def name(self) -> str:
        """The device and the browser as a text."""
        return f"{self.about['device']}, {self.about['browser']}"


def read_bench(path: Path) -> BrowserBench:
    """Read a bench file.

    Raises:
        InputError: if the file can't be read, or is not a bench file.
    """
    try:
        content = json.loads(path.read_bytes()[:MAX_BYTES])
        if content["format"] != FORMAT:
            raise ValueError(f"its format is not '{FORMAT}'")
        rows = tuple(
            {name: _check_value(row, name, kind) for name, kind in ROW_FIELDS.items()}
            | {name: _check_value(row, name, float, optional=True) for name in OPTIONAL_ROW_FIELDS}
            for row in content["rows"]
        )
        if not rows:
            raise ValueError("it has no rows")
        return BrowserBench(
            {name: _check_value(content, name, kind) for name, kind in FILE_FIELDS.items()}, rows
        )
    except OSError as error:
        raise InputError(f"--add {path}: {describe_read_error(error)}") from None
    except (ValueError, KeyError, TypeError) as error:
        expected = "must be a file from the bench page of memmlp web"
        raise InputError(f"--add {path}: {error}; {expected}") from None


def _check_value(fields: Mapping[str, Any], name: str, kind: type, optional: bool = False) -> Any:
    """Return a text that is safe for a terminal, or a number above 0. Raises ValueError for other values."""
    value = fields[name]
    if kind is str and isinstance(value, str) and 0 < len(value) <= 300:
        return escape_line_breaks(value)
    if kind is float and type(value) in (int, float) and math.isfinite(value) and value > 0:
        return value
    if optional and value is None:
        return None
    raise ValueError(f"{name}={str(value)[:60]}: must be a {'text' if kind is str else 'number above 0'}")


def add_rows(table: Table, measured: BrowserBench) -> Table:
    """Add a browser's rows to Table 17.

    Differences refer to AvatarPoser as published, in the same browser on the same backend. The column `ratio`
    refers to the same fixed yardstick as in other rows.

    Raises:
        InputError: if the table is not Table 17.
    """
    if table.number != TABLE_NUMBER:
        raise InputError(f"--add: must be used with memmlp table {TABLE_NUMBER}, not with {table.name}")
    own = [row for row in measured.rows if (row["network"], row["graph"], row["precision"]) == BASE_NETWORK]
    bases = {row["backend"]: row for row in own}
    rows = [_make_row(table, measured, row, bases.get(row["backend"])) for row in measured.rows]
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


def _make_row(
    table: Table, measured: BrowserBench, row: Mapping[str, Any], base: Mapping[str, Any] | None
) -> Row:
    other = base if base is not row else None
    costs, others = _list_costs(row), _list_costs(other) if other else {}

    def make_cell(metric: str) -> Cell:
        value, theirs = costs.get(metric), others.get(metric)
        effect = None if value is None or theirs is None else Effect(value - theirs)
        return Cell({} if value is None else {0: value}, effect=effect)

    return Row(
        label=_make_label(measured, row),
        branch=table.rows[0].branch,
        against=_make_label(measured, other) if other else None,
        note=None,
        found=(0,),
        wanted=(0,),
        cells={mode: {metric: make_cell(metric) for metric in table.metrics} for mode in table.modes},
    )


def _make_label(measured: BrowserBench, row: Mapping[str, Any]) -> str:
    """Return a row's label. It contains the network's size, because sites may use different sizes."""
    graph, size = GRAPHS.get(row["graph"], row["graph"]), row["parameters"] / 1e6
    how = f"{graph}, {row['precision']}, {row['backend']}"
    return f"{row['network']} of {size:.3g} M parameters, {how}: {measured.name}"


def _list_costs(row: Mapping[str, Any]) -> dict[str, float | None]:
    return {
        "ms": row["median_ms"],
        "pose ms": row["whole_median_ms"],
        "ratio": row["ratio_to_yardstick"],
        "FPS": 1000 / row["median_ms"],
    }
