"""A table's numbers as words in rows and columns, the same for every format."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from memmlp.sweep.spec import COSTS
from memmlp.tables.collect import Cell, Row, Table
from memmlp.units import UNITS

COST_UNITS = {"FLOPs": "G", "MACs": "G", "parameters": "M", "size": "MB", "ms": "", "ratio": "", "FPS": ""}
MISSING = "-"
MINUS = "\N{MINUS SIGN}"


@dataclass(frozen=True)
class Line:
    """A line of an arm.

    Attributes:
        kind: "measured", "difference" (from the reference) or "paper". head: its first two cells.
        cells: one a metric, each of one or two parts.
    """

    kind: str
    head: tuple[str, str]
    cells: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Grid:
    """The lines of one evaluation mode, arm by arm; `mode` is None where the columns know none."""

    mode: str | None
    header: tuple[str, ...]
    groups: tuple[tuple[Line, ...], ...]


def grids(table: Table) -> list[Grid]:
    """One grid a mode; one without a mode where all would be the same: of costs, or with nothing measured."""
    timeless = set(table.metrics) <= set(COSTS) or not any(row.found for row in table.rows)
    header = ("arm", "seeds", *map(heading, table.metrics))
    return [
        Grid(
            None if timeless else mode,
            header,
            tuple(tuple(_lines(table, row, mode)) for row in table.rows),
        )
        for mode in (table.modes[:1] if timeless else table.modes)
    ]


def heading(metric: str) -> str:
    """A metric with its unit and the direction that is better."""
    unit = UNITS.get(metric, COST_UNITS.get(metric, "")).replace("10^2", "10²").replace("s^3", "s³")
    return " ".join(
        word for word in (metric, f"[{unit}]" if unit else "", "↑" if metric == "FPS" else "↓") if word
    )


def caption(table: Table) -> str:
    """The table's title."""
    return f"Table {table.number}: {table.title}" if table.number else table.title


def legend(table: Table) -> list[str]:
    """How to read the lines, where there is something measured."""
    if not any(row.found for row in table.rows):
        return []
    timeless = set(table.metrics) <= set(COSTS)
    lines = [] if timeless else ["mean ± sd over seeds of the means over test clips"]
    if table.comparisons:
        lines.append(
            f"difference from '{table.reference}' [95 % interval, bootstrap paired by seed and test clip]; "
            f"* p < 0.05 by Holm's correction over the table's {table.comparisons} comparisons"
        )
    agreeing, known, surely, sure = table.signs
    if known:
        among = f", {surely} of {sure} of the significant ones" if sure else ""
        lines.append(
            "paper's value (its difference; ✓ ours has the same sign, ✗ the opposite): "
            f"{agreeing} of {known} signs as in the paper{among}"
        )
    return lines


def _lines(table: Table, row: Row, mode: str) -> Iterable[Line]:
    """An arm's lines: measured, its difference, the paper's; of the paper's own rows that alone."""
    cells = [(row.cells[mode][metric], metric) for metric in table.metrics]
    paper = tuple((_paper(cell, metric),) for cell, metric in cells)
    if row.paper_only:
        yield Line("paper", (row.label, "paper"), paper)
        return
    seeds = f"{len(row.found)}/{len(row.wanted)}"
    yield Line("measured", (row.label, seeds), tuple((_value(cell, metric),) for cell, metric in cells))
    if any(cell.effect for cell, _ in cells):
        effects = tuple(_effect(cell, metric) for cell, metric in cells)
        yield Line("difference", ("", "diff."), effects)
    if any(cell.paper is not None for cell, _ in cells):
        yield Line("paper", ("", "paper"), paper)


def _value(cell: Cell, metric: str) -> str:
    """Mean ± sd."""
    if cell.mean is None:
        return MISSING
    if metric in COSTS and (metric != "ms" or cell.sd is None):
        return f"{cell.mean:.3g}" if cell.mean < 1000 else f"{cell.mean:.0f}"
    sd = "" if cell.sd is None else f" ± {cell.sd:.2f}"
    return f"{cell.mean:.2f}{sd}"


def _effect(cell: Cell, metric: str) -> tuple[str, ...]:
    """The difference, starred where it is significant, and its interval; of a cost the ratio."""
    effect = cell.effect
    if effect is None:
        return (MISSING,)
    if metric in COSTS:
        return _signed(effect.mean, "+.3g"), *_ratio(cell.mean, effect.mean)
    if effect.low is None or effect.high is None:
        return (_signed(effect.mean, "+.2f"),)
    places = _places(effect.high - effect.low)
    low, high = (_signed(number, f".{places}f") for number in (effect.low, effect.high))
    star = "*" if effect.significant else ""
    return _signed(effect.mean, f"+.{places}f") + star, f"[{low}, {high}]"


def _ratio(value: float | None, difference: float) -> tuple[str, ...]:
    """How many times the reference's a cost is that differs from it by so much."""
    if value is None or value == difference:
        return ()
    return (f"(x {value / (value - difference):.3g})",)


def _signed(number: float, form: str) -> str:
    """A number with a proper minus."""
    return format(number, form).replace("-", MINUS) if number else "0"


def _places(width: float) -> int:
    """Decimals that show two digits of an interval's half width; 2 or 3."""
    return min(max(1 - math.floor(math.log10(width / 2)), 2), 3) if width > 0 else 2


def _paper(cell: Cell, metric: str) -> str:
    """The paper's value, its difference from the reference, and whether ours has its sign."""
    if cell.paper is None:
        return MISSING
    places = 1 if metric in ("ms", "FPS") else 2
    value = f"{cell.paper:.{places}f}"
    if cell.paper_effect is None:
        return value
    mark = {None: "", True: " ✓", False: " ✗"}[cell.agrees]
    ratio = "".join(f" {words}" for words in _ratio(cell.paper, cell.paper_effect)) if metric in COSTS else ""
    return f"{value} ({_signed(cell.paper_effect, f'+.{places}f')}{mark}){ratio}"
