"""Rows of Table 17 that were measured in a browser: the output of `memmlp web`'s bench, read and checked."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError, one_line, why_unreadable
from memmlp.tables.table import Cell, Effect, Row, Table

FORMAT = "memmlp web bench 1"
NUMBER = 17  # the table's, in the paper
LARGEST = 1_000_000  # bytes of a file
GRAPHS = {"naive": "as published", "streaming": "stream"}
BASE = ("AvatarPoser", "naive", "fp32")
"""The network to which ratios on the page refer: AvatarPoser as published."""

Check = Callable[[Any], bool]


def _text(value: Any) -> bool:
    return isinstance(value, str) and 0 < len(value) <= 300


def _positive(value: Any) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and math.isfinite(value) and value > 0


def _maybe(value: Any) -> bool:
    return value is None or _positive(value)


def _count(value: Any) -> bool:
    return _positive(value) and value == int(value)


TEXT, NUMBER_ABOVE_0, OR_NULL, COUNT = "text", "a number above 0", "a number above 0, or null", "a count"
CHECKS: dict[str, Check] = {TEXT: _text, NUMBER_ABOVE_0: _positive, OR_NULL: _maybe, COUNT: _count}
FILE = {"device": TEXT, "browser": TEXT, "onnxruntime_web": TEXT, "date": TEXT, "clock_ms": NUMBER_ABOVE_0}
ROW = {
    "network": TEXT, "parameters": COUNT, "graph": TEXT, "precision": TEXT, "backend": TEXT,
    "threads": COUNT, "steps": COUNT,
    "median_ms": NUMBER_ABOVE_0, "p95_ms": NUMBER_ABOVE_0, "ratio_to_avatar_poser": OR_NULL,
    "ratio_to_yardstick": OR_NULL, "whole_median_ms": OR_NULL, "whole_p95_ms": OR_NULL,
}  # fmt: skip


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
        InputError: if the file can't be read, or is no file of the bench.
    """
    try:
        text = path.read_text(encoding="utf-8") if path.stat().st_size <= LARGEST else ""
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"--add {path}: {why_unreadable(error)}") from None
    try:
        found = json.loads(text)
    except ValueError as error:
        raise InputError(f"--add {path}: no JSON ({error}); {_ALLOWED}") from None
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise InputError(f"--add {path}: its format is not '{FORMAT}'; {_ALLOWED}")
    rows = found.get("rows")
    if not isinstance(rows, list) or not rows or not all(isinstance(row, dict) for row in rows):
        raise InputError(f"--add {path}: rows: none; {_ALLOWED}")
    _check(path, "", found, FILE)
    for index, row in enumerate(rows):
        _check(path, f"rows[{index}].", row, ROW)
    return BrowserBench(
        {key: _shown(found[key]) for key in FILE}, tuple({k: _shown(r[k]) for k in ROW} for r in rows)
    )


_ALLOWED = "allowed is what the bench of a site of memmlp web copies or saves"


def _check(path: Path, where: str, found: Mapping[str, Any], fields: Mapping[str, str]) -> None:
    for key, kind in fields.items():
        if key not in found:
            raise InputError(f"--add {path}: {where}{key}: missing; {_ALLOWED}")
        if not CHECKS[kind](found[key]):
            raise InputError(f"--add {path}: {where}{key}: {str(found[key])[:60]}; allowed is {kind}")


def _shown(value: Any) -> Any:
    """Return a value with texts made safe to print on a terminal."""
    return one_line(value) if isinstance(value, str) else value


def with_rows(table: Table, measured: BrowserBench) -> Table:
    """Return Table 17 with a browser's rows below its own.

    Their differences and ratios compare with AvatarPoser as published, in the same browser on the same
    backend. The column `ratio` compares with the same fixed yardstick as in the other rows.

    Raises:
        InputError: for a table other than Table 17.
    """
    if table.number != NUMBER:
        raise InputError(f"--add: {table.name} is not Table {NUMBER}; allowed is memmlp table {NUMBER}")
    bases = {row["backend"]: row for row in measured.rows if _kind(row) == BASE}
    rows = [_row(table, measured, row, bases.get(row["backend"])) for row in measured.rows]
    return replace(table, rows=(*table.rows, *rows), flags=(*table.flags, *_told(measured)))


def _kind(row: Mapping[str, Any]) -> tuple[str, str, str]:
    return row["network"], row["graph"], row["precision"]


def _label(measured: BrowserBench, row: Mapping[str, Any]) -> str:
    """Name a row, with its network's size, as a site's networks may differ in size from the table's own."""
    graph, size = GRAPHS.get(row["graph"], row["graph"]), row["parameters"] / 1e6
    how = f"{graph}, {row['precision']}, {row['backend']}"
    return f"{row['network']} of {size:.3g} M parameters, {how}: {measured.name}"


def _row(table: Table, measured: BrowserBench, row: Mapping[str, Any], base: Mapping[str, Any] | None) -> Row:
    costs, others = _costs(row), _costs(base) if base and base is not row else {}

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


def _costs(row: Mapping[str, Any]) -> dict[str, float | None]:
    """Return a row's values by the table's metrics."""
    return {
        "ms": row["median_ms"],
        "network ms": None,
        "pose ms": row["whole_median_ms"],
        "ratio": row["ratio_to_yardstick"],
        "FPS": 1000 / row["median_ms"],
    }


def _told(measured: BrowserBench) -> list[str]:
    """Return notes that say how the rows were measured."""
    about, clock = measured.about, f"a clock of {measured.about['clock_ms']:.2g} ms"
    threads, steps = (_values(measured, key) for key in ("threads", "steps"))
    how = f"{threads} thread{'s' * (threads != '1')}, the median of {steps} steps, {clock}"
    return [
        f"{measured.name}: onnxruntime-web {about['onnxruntime_web']}, {how}, {about['date'][:10]}; a whole "
        "pose is by the full graph; differences are from AvatarPoser as published, there on the same backend"
    ]


def _values(measured: BrowserBench, key: str) -> str:
    """Return a key's counts in the rows: one number, or all of them if rows differ."""
    return " or ".join(map(str, sorted({int(row[key]) for row in measured.rows})))
