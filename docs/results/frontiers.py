"""Frontiers: error against training compute and latency."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from io import BytesIO
from typing import TYPE_CHECKING, NamedTuple

from memmlp.report.tables.table import Row, Table
from memmlp.report.tables.table_text import add_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COMPUTE, LATENCY = "tflop", "ratio"
MIN_RATIO = 1.1  # minimum ratio between the largest and the smallest cost of a frontier


class Point(NamedTuple):
    """A variant's place on a frontier.

    Attributes:
        series: the network, whose variants with other budgets are on the same curve.
        label: the variant's label.
        cost: training compute in TFLOP, or a live step's time as a multiple of the yardstick's.
        mean, low, high: the error with its 95 % interval over seeds and clip groups; without an interval, all
            are the mean.
    """

    series: str
    label: str
    cost: float
    mean: float
    low: float
    high: float


def list_costs(table: Table) -> list[str]:
    """Return the costs of a table's frontiers: compute if a network has several budgets, and latency.

    Latency alone makes a frontier if it is a column and the training compute is known. At least three
    variants must have a known latency, and it must differ.
    """
    known = [row for row in table.rows if COMPUTE in row.costs]
    if not table.measured_metrics or not known:
        return []
    budgets = any(_has_budgets(table, name) for name in {row.series for row in known})
    prices = (find_cost(row, table.modes[0], LATENCY) for row in table.rows)
    times = [price for price in prices if price is not None]
    timed = len(times) > 2 and max(times) > MIN_RATIO * min(times) and (budgets or LATENCY in table.metrics)
    return [COMPUTE] * budgets + [LATENCY] * timed


def _has_budgets(table: Table, series: str) -> bool:
    found = [row.costs[COMPUTE] for row in table.rows if row.series == series and COMPUTE in row.costs]
    return max(found) > MIN_RATIO * min(found)


def choose_metric(table: Table) -> str:
    """Return MPJPE if the table has it, otherwise its first error metric."""
    return "MPJPE" if "MPJPE" in table.measured_metrics else table.measured_metrics[0]


def list_points(table: Table, cost: str) -> Iterator[Point]:
    """Yield the places of the table's variants with a known cost, in its first mode, by series and cost.

    Against compute, only networks with several budgets count.
    """
    mode, metric = table.modes[0], choose_metric(table)
    known = [(row, price) for row in table.rows if (price := find_cost(row, mode, cost)) is not None]
    if cost == COMPUTE:
        known = [one for one in known if _has_budgets(table, one[0].series)]
    for row, price in sorted(known, key=lambda one: (one[0].series, one[1])):
        cell = row.cells[mode][metric]
        if cell.mean is not None:
            low, high = (cell.mean if one is None else one for one in (cell.low, cell.high))
            yield Point(row.series, row.label, price, cell.mean, low, high)


def find_cost(row: Row, mode: str, cost: str) -> float | None:
    """Return a variant's cost: that of its column, which leaves out times of a busy machine, or its mean."""
    cells = row.cells[mode]
    return cells[cost].mean if cost in cells else row.costs.get(cost)


WIDE = 2.0  # minimum ratio between the largest and the smallest error for a logarithmic axis
SHIFT = 1.015  # ratio of neighbouring networks' places, so that intervals at one budget do not overlap
LABELS = {COMPUTE: "training compute [TFLOP]", LATENCY: "time of a live step / yardstick's"}


def draw_frontiers(table: Table) -> bytes:
    """Return a picture (SVG) of error against each of the table's costs (`list_costs`), side by side."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    points = {cost: list(list_points(table, cost)) for cost in list_costs(table)}
    names = sorted({point.series for found in points.values() for point in found})
    with rc_context({"svg.hashsalt": table.name, "font.size": 9}):
        figure = Figure(figsize=(9, 3.5 + 0.1 * len(names)), layout="constrained")
        first = None
        for number, (cost, found) in enumerate(points.items(), 1):
            first = axes = figure.add_subplot(1, len(points), number, sharey=first)
            _draw_points(axes, found, names, cost == COMPUTE)
            axes.set_xscale("log", subs=[])
            means = [point.mean for point in found]
            wide = max(means) > WIDE * min(means)
            if wide:
                axes.set_yscale("log", subs=[])
            for axis in (axes.xaxis, *[axes.yaxis] * wide):
                axis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
                axis.set_major_formatter("{x:g}")
            axes.set(xlabel=LABELS[cost], ylabel=add_unit(choose_metric(table)))
            axes.grid(alpha=0.25)
        handles, labels = figure.axes[-1].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
        picture = BytesIO()
        figure.savefig(picture, format="svg", metadata={"Date": None})
    return picture.getvalue()


def _draw_points(axes: Axes, points: Sequence[Point], names: Sequence[str], joined: bool) -> None:
    """Draw the points of each network; joined points of several networks at one cost stand side by side."""
    for name, group in itertools.groupby(points, key=lambda point: point.series):
        own = list(group)
        sides = [[one.mean - one.low for one in own], [one.high - one.mean for one in own]]
        place = names.index(name)
        colour, shift = f"C{place % 10}", SHIFT ** (place - len(names) / 2) if joined else 1.0
        axes.errorbar(
            [shift * one.cost for one in own], [one.mean for one in own], sides, label=name, color=colour,
            marker="os^"[place // 10 % 3], markersize=4, linestyle="-" if joined else "", linewidth=1.2,
            elinewidth=0.6,
        )  # fmt: skip
