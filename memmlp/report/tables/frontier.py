"""Frontiers: each network's error against its training compute and its live latency."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from memmlp.report.tables.table import Table

COMPUTE, LATENCY = "tflop", "ms"
COST_HEADINGS = {
    "parameters": "parameters [M]", "MACs": "MACs [G]", COMPUTE: "training [TFLOP]",
    "seconds": "training [s]", LATENCY: "step [ms]",
}  # fmt: skip
MIN_RATIO = 1.1  # minimum ratio between two budgets of a frontier


class Point(NamedTuple):
    """A variant's place on a frontier.

    Attributes:
        series: the network, whose variants with other budgets are on the same curve.
        label: the variant's label.
        cost: training compute in TFLOP, or latency in ms.
        mean, low, high: the error with its 95 % interval over seeds and clip groups; without an interval, all
            are the mean.
    """

    series: str
    label: str
    cost: float
    mean: float
    low: float
    high: float


def has_frontier(table: Table) -> bool:
    """Return whether the variants' training compute is known and differs."""
    known = [row.costs[COMPUTE] for row in table.rows if COMPUTE in row.costs]
    return bool(table.measured_metrics) and len(known) > 1 and max(known) > MIN_RATIO * min(known)


def choose_metric(table: Table) -> str:
    """Return MPJPE if the table has it, otherwise its first error metric."""
    return "MPJPE" if "MPJPE" in table.measured_metrics else table.measured_metrics[0]


def list_points(table: Table, cost: str) -> Iterator[Point]:
    """Yield the places of the table's variants with a known cost, in its first mode, by series and cost."""
    mode, metric = table.modes[0], choose_metric(table)
    for row in sorted(table.rows, key=lambda row: (row.series, row.costs.get(cost, 0.0))):
        cell = row.cells[mode][metric]
        if cost in row.costs and cell.mean is not None:
            low, high = (cell.mean if one is None else one for one in (cell.low, cell.high))
            yield Point(row.series, row.label, row.costs[cost], cell.mean, low, high)
