"""Frontiers drawn with matplotlib: one curve for each network, with intervals, over a logarithmic axis."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from io import BytesIO
from typing import TYPE_CHECKING

from memmlp.report.tables.frontier import COMPUTE, LATENCY, Point, choose_metric, list_points
from memmlp.report.tables.table import Table
from memmlp.report.tables.table_text import add_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SHIFT = 1.015  # ratio of neighbouring networks' places, so that intervals at one budget do not overlap
LABELS = {COMPUTE: "training compute [TFLOP]", LATENCY: "live latency of a step [ms]"}


def draw_frontiers(table: Table) -> bytes:
    """Return a picture (SVG) of error against training compute and against latency, side by side."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    points = {cost: list(list_points(table, cost)) for cost in LABELS}
    names = sorted({point.series for found in points.values() for point in found})
    with rc_context({"svg.hashsalt": table.name, "font.size": 9}):
        figure = Figure(figsize=(9, 3.6), layout="constrained")
        first = None
        for number, (cost, found) in enumerate(points.items(), 1):
            first = axes = figure.add_subplot(1, 2, number, sharey=first)
            _draw_curves(axes, found, names, SHIFT if cost == COMPUTE else 1.0)
            axes.set_xscale("log", subs=[])
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.set(xlabel=LABELS[cost], ylabel=add_unit(choose_metric(table)))
            axes.grid(alpha=0.25)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=5, frameon=False)
        picture = BytesIO()
        figure.savefig(picture, format="svg", metadata={"Date": None})
    return picture.getvalue()


def _draw_curves(axes: Axes, points: Sequence[Point], names: Sequence[str], ratio: float) -> None:
    """Draw a curve for each network; `ratio` is the distance between neighbouring networks at one cost."""
    for name, group in itertools.groupby(points, key=lambda point: point.series):
        own = list(group)
        sides = [[one.mean - one.low for one in own], [one.high - one.mean for one in own]]
        colour, shift = f"C{names.index(name) % 10}", ratio ** (names.index(name) - len(names) / 2)
        axes.errorbar(
            [shift * one.cost for one in own], [one.mean for one in own], sides, label=name, color=colour,
            marker="o", markersize=4, capsize=2, linewidth=1.4,
        )  # fmt: skip
