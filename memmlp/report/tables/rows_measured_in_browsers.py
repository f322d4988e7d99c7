"""Rows of Table 17 that were measured in a browser: the output of `memmlp web`'s bench, read and checked."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError, one_line, why_unreadable
from memmlp.report.tables.table import Cell, Effect, Row, Table

FORMAT = "memmlp web bench 1"
NUMBER = 17  # the table's, in the paper
LARGEST = 1_000_000  # bytes of a file
GRAPHS = {"naive": "as published", "streaming": "stream"}
BASE = ("AvatarPoser", "naive", "fp32")
"""The network to which ratios on the page refer: AvatarPoser as published."""


def _is_number(value: Any) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and math.isfinite(value) and value > 0


CHECKS: dict[str, Callable[[Any], bool]] = {
    "text": lambda value: isinstance(value, str) and 0 < len(value) <= 300,
    "a number above 0": _is_number,
    "a number above 0, or null": lambda value: value is None or _is_number(value),
    "a count": lambda value: _is_number(value) and value == int(value),
}
TEXT, NUMBER_ABOVE_0, OR_NULL, COUNT = CHECKS
FILE = {"device": TEXT, "browser": TEXT, "onnxruntime_web": TEXT, "date": TEXT, "clock_ms": NUMBER_ABOVE_0}
ROW = {
    "network": TEXT, "parameters": COUNT, "graph": TEXT, "precision": TEXT, "backend": TEXT,
    "threads": COUNT, "steps": COUNT,
    "median_ms": NUMBER_ABOVE_0, "p95_ms": NUMBER_ABOVE_0, "ratio_to_avatar_poser": OR_NULL,
    "ratio_to_yardstick": OR_NULL, "whole_median_ms": OR_NULL, "whole_p95_ms": OR_NULL,
}  # fmt: skip
EXPECTED = "expected a file that the bench of a site of memmlp web copies or saves"


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
        text = path.read_text(encoding="utf-8") if path.stat().st_size <= LARGEST else ""
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"--add {path}: {why_unreadable(error)}") from None
    try:
        content = json.loads(text)
    except ValueError as error:
        raise InputError(f"--add {path}: not JSON ({error}); {EXPECTED}") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f"--add {path}: its format is not '{FORMAT}'; {EXPECTED}")
    rows = content.get("rows")
    if not isinstance(rows, list) or not rows or not all(isinstance(row, dict) for row in rows):
        raise InputError(f"--add {path}: rows: {EXPECTED}")
    about = _checked(path, "", content, FILE)
    return BrowserBench(
        about, tuple(_checked(path, f"rows[{index}].", row, ROW) for index, row in enumerate(rows))
    )


def _checked(path: Path, where: str, found: Mapping[str, Any], fields: Mapping[str, str]) -> dict[str, Any]:
    """Return the fields, with texts made safe to print on a terminal."""
    for key, kind in fields.items():
        if key not in found:
            raise InputError(f"--add {path}: {where}{key}: missing; {EXPECTED}")
        if not CHECKS[kind](found[key]):
            raise InputError(f"--add {path}: {where}{key}: {str(found[key])[:60]}; expected {kind}")
    return {key: one_line(found[key]) if isinstance(found[key], str) else found[key] for key in fields}


def with_rows(table: Table, measured: BrowserBench) -> Table:
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
    costs = _costs(row)
    others = _costs(base) if base and base is not row else {}

    def cell(metric: str) -> Cell:
        value, other = costs.get(metric), others.get(metric)
        effect = None if value is None or other is None else Effect(value - other)
        return Cell({} if value is None else {0: value}, effect=effect)

    return Row(
        label=_label(measured, row),
        branch=table.rows[0].branch,
        against=_label(measured, base) if base and base is not row else None,
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
