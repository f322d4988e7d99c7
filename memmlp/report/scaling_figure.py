"""The figure of a sweep's effects against its scale: rows are effects, columns are metrics."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullFormatter

from memmlp.common.files import digest
from memmlp.sweep.definition import COMPUTE
from memmlp.tables.effects_along_axes import EffectOfCell, Trend, Trends
from memmlp.tables.table_text import with_unit

INK, LINE, FAINT, AHEAD = "#1f2328", "#0969da", "#d0d7de", "#bc4c00"
STYLE: Any = {
    "font.family": "sans-serif", "font.size": 8, "axes.titlesize": 8, "axes.spines.top": False,
    "axes.spines.right": False, "text.color": INK, "axes.labelcolor": INK, "axes.edgecolor": INK,
    "xtick.color": INK, "ytick.color": INK, "lines.linewidth": 1.2,
}  # fmt: skip
SIZE = (2.7, 1.9)  # of a panel, inches
DOTS = 110  # an inch
CURVE = 60  # points of a line
WIDEST = 2.0  # of the measured decades: as many more are shown for a prediction, or it is left to the table
HIGHEST = 1.0  # of the measured heights: as many more are shown on either side for a prediction
DIGITS = 5  # of the numbers that decide whether a figure is drawn again
LOOK = 1  # raised when the same numbers are drawn otherwise, so that figures are drawn again
DATA = "Comment"  # the entry of the file that has the digest of what is drawn


def figure_digest(found: Trends) -> str:
    """Return a digest of the numbers in the figure, and of the way in which it shows them."""

    def short(number: float) -> str:
        return f"{number:.{DIGITS}g}"

    numbers = [
        [
            [trend.series, trend.metric, trend.varied],
            [
                [*map(short, point.values.values()), *map(short, vars(point.effect).values())]
                for point in trend.points
            ],
            [[short(slope.change.mean), str(slope.verdict)] for slope in trend.slopes.values()],
            [short(end) for end in vars(trend.at()).values()] if trend.line else [],
        ]
        for trend in found.trends
    ]
    return digest([LOOK, numbers, found.predict, found.compute, found.along])


def figure_is_of(path: Path, found: Trends) -> bool:
    """Return whether a file is the figure for these numbers."""
    if not path.is_file():
        return False
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            return image.info.get(DATA) == figure_digest(found)
    except (OSError, UnidentifiedImageError):
        return False


@mpl.rc_context(STYLE)
def scaling_figure(found: Trends) -> bytes:
    """Draw the effects with their lines, as a PNG; points that differ in more than the axis are hollow."""
    series, metrics = found.series, found.metrics
    figure = Figure(figsize=(SIZE[0] * len(metrics), SIZE[1] * len(series) + 0.5), dpi=DOTS)
    axes = figure.subplots(len(series), len(metrics), squeeze=False, sharex=True)
    for trend in found.trends:
        _panel(axes[series.index(trend.series), metrics.index(trend.metric)], trend, found)
    for axis, metric in zip(axes[0], metrics, strict=True):
        axis.set_title(with_unit(metric))
    for row, label in zip(axes, series, strict=True):
        row[0].set_ylabel(label)
    figure.supxlabel(_label(found), fontsize=8)
    figure.set_layout_engine("constrained")
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": None, DATA: figure_digest(found)})
    return file.getvalue()


def _label(found: Trends) -> str:
    """Describe the figure's axis and its marks."""
    name = found.along[0]
    words = ["training compute of the control, FLOP" if name == COMPUTE else name]
    if len(found.along) > 1:
        words.append(f"hollow: less than the largest {' or '.join(found.along[1:])}")
    if _ahead(found):
        words.append(f"orange: {found.predict}, 95 % interval for one more cell there")
    return "; ".join(words)


def _ahead(found: Trends) -> float | None:
    """Return the compute for which effects are predicted, if it fits on the figure's axis."""
    ends = found.measured(COMPUTE)
    if found.along[0] != COMPUTE or found.compute is None or ends is None:
        return None
    beyond, span = math.log10(found.compute / ends[1]), math.log10(ends[1] / ends[0])
    return found.compute if beyond <= WIDEST * span else None


def _panel(axis: Axes, trend: Trend, found: Trends) -> None:
    name, ahead = found.along[0], _ahead(found)
    axis.axhline(0, color=FAINT, zorder=0)
    axis.set_xscale("log")
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.yaxis.set_major_locator(MaxNLocator(4))
    for point in trend.points:
        _point(axis, point, name, trend)
    if trend.line is None or name not in trend.varied:
        axis.text(0.5, 0.9, "no line", transform=axis.transAxes, ha="center", color=INK)
        return
    x = [point.values[name] for point in trend.points]
    _curve(axis, trend, name, min(x), max(x), "-")
    if ahead is not None and ahead > max(x):
        _curve(axis, trend, name, max(x), ahead, ":")
    if ahead is not None and trend.predicted is not None:
        there = trend.predicted.effect
        axis.errorbar(
            [ahead], [there.mean], [[there.mean - there.low], [there.high - there.mean]],
            fmt="D", color=AHEAD, markersize=4, capsize=2,
        )  # fmt: skip
    axis.set_ylim(*_limits(trend, name, ahead))
    verdict = trend.slopes[name].verdict
    axis.text(0.02, 0.98, str(verdict or ""), transform=axis.transAxes, va="top", color=INK)


def _limits(trend: Trend, name: str, ahead: float | None) -> tuple[float, float]:
    """Return the lower and upper limit of a panel; long bars and wide predictions are cut off there."""
    x = [point.values[name] for point in trend.points]
    ends = trend.curve([{name: min(x)}, {name: max(x)}])
    every = [0.0, *(point.effect.mean for point in trend.points), *ends.low, *ends.high]
    low, high = min(every), max(every)
    margin = 0.15 * (high - low or 1.0)
    if ahead is not None and trend.predicted is not None:
        there, room = trend.predicted.effect, HIGHEST * (high - low)
        low, high = min(low, max(there.low, low - room)), max(high, min(there.high, high + room))
    return low - margin, high + margin


def _point(axis: Axes, point: EffectOfCell, name: str, trend: Trend) -> None:
    """Draw a cell's effect with its own interval."""
    if name not in point.values:
        return
    whole = all(point.values[other] == trend.most[other] for other in trend.varied if other != name)
    effect = point.effect
    ends = [[effect.mean - effect.low], [effect.high - effect.mean]]
    axis.errorbar(
        [point.values[name]], [effect.mean], ends if math.isfinite(effect.high) else None,
        fmt="o", color=INK, markerfacecolor=INK if whole else "white", markersize=3.5, elinewidth=0.6,
    )  # fmt: skip


def _curve(axis: Axes, trend: Trend, name: str, first: float, last: float, style: str) -> None:
    """Draw the line and its band between two values."""
    x = np.geomspace(first, last, CURVE)
    line = trend.curve([{name: float(value)} for value in x])
    axis.plot(x, line.mean, color=LINE, linestyle=style)
    axis.fill_between(x, line.low, line.high, color=LINE, alpha=0.15 if style == "-" else 0.07, linewidth=0)
