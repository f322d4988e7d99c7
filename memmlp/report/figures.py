"""The figures of the page, as inline SVG that uses the page's colours."""

from __future__ import annotations

import html
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullFormatter, ScalarFormatter

from memmlp.sweep.definition import COSTS
from memmlp.tables.error_distributions import Distribution
from memmlp.tables.statistics import performance_profile
from memmlp.tables.table import Cell, Table
from memmlp.tables.table_text import heading

# Placeholder colours for matplotlib, which `_svg` replaces by the page's, so that it has a dark mode.
INK, FAINT = "#010203", "#010204"
SERIES = tuple(f"#0102{number:02x}" for number in range(0x10, 0x18))
COLOURS = {INK: "currentColor", FAINT: "var(--line)"}
COLOURS |= {name: f"var(--series{number})" for number, name in enumerate(SERIES)}
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
STYLE: Any = {
    "svg.fonttype": "none", "font.family": "sans-serif", "font.size": 9, "text.color": INK,
    "axes.labelcolor": INK, "axes.edgecolor": FAINT, "xtick.color": INK, "ytick.color": INK,
    "grid.color": FAINT, "axes.facecolor": "none", "figure.facecolor": "none",
    "legend.frameon": False, "axes.titlesize": 9, "axes.spines.top": False,
    "axes.spines.right": False, "legend.labelcolor": INK, "lines.linewidth": 1.4,
}  # fmt: skip
WIDTH = 10.5  # inches
LABEL = 34  # the longest label of an arm in a figure, characters
PANELS = 4  # the largest number of panels side by side
NAMED = 12  # the largest number of our points that are named in a figure


class SpeedAndError(NamedTuple):
    """A system's frames per second and its error."""

    label: str
    fps: float
    error: float


class Curve(NamedTuple):
    """The values of a run by training step."""

    steps: Sequence[int]
    values: Sequence[float]


@mpl.rc_context(STYLE)
def forest(table: Table) -> str | None:
    """Draw the differences from the control with their intervals, by arm and metric.

    Return None if there are no differences.
    """
    metrics = [metric for metric in table.metrics if metric not in COSTS]
    rows = [
        row for row in table.rows if any(c.effect for cells in row.cells.values() for c in cells.values())
    ]
    if not metrics or not rows:
        return None
    deep = -(-len(metrics) // PANELS)
    figure, axes = _panels(len(metrics), deep * (0.9 + 0.42 * len(rows)))
    for column, (axis, metric) in enumerate(zip(axes, metrics, strict=True)):
        axis.axvline(0, color=FAINT, zorder=0)
        if metric in table.smallest:
            least = table.smallest[metric]
            axis.axvspan(-least, least, color=FAINT, alpha=0.35, linewidth=0, zorder=0)
        for place, row in enumerate(rows):
            for number, mode in enumerate(table.modes):
                shift = 0.14 * (2 * number - len(table.modes) + 1)
                _bar(axis, row.cells[mode][metric], place + shift, number)
            paper = row.cells[table.modes[0]][metric].paper_effect
            if paper is not None:
                axis.plot(
                    paper, place, marker="D", color=INK, markerfacecolor="none", markersize=5, linestyle=""
                )
        axis.set(title=heading(metric), ylim=(len(rows) - 0.5, -0.5))
        axis.set_yticks(range(len(rows)), [_short(row.label) for row in rows])
        axis.tick_params(axis="y", length=0, labelleft=column % PANELS == 0)
        axis.xaxis.set_major_locator(MaxNLocator(4))
        axis.spines["left"].set_visible(False)
    _legend(figure, [*table.modes, "paper"], ["o"] * len(table.modes) + ["D"])
    return _svg(figure, f"forest-{table.name}", f"differences from {table.control}")


@mpl.rc_context(STYLE)
def profiles(name: str, found: Mapping[str, Sequence[Distribution]]) -> str:
    """Draw performance profiles: a panel for each metric, a curve for each arm."""
    figure, axes = _panels(len(found), 2.8 * -(-len(found) // PANELS))
    for axis, (metric, arms) in zip(axes, found.items(), strict=True):
        every = np.concatenate([arm.errors for arm in arms if arm.errors.size])
        every = every[np.isfinite(every)]
        thresholds = np.linspace(every.min(), every.max(), 101)
        for number, arm in enumerate(arms):
            if arm.errors.size:
                fractions = performance_profile(arm.errors, thresholds)
                axis.plot(thresholds, fractions, color=SERIES[number % len(SERIES)])
        axis.set(xlabel=heading(metric), ylim=(-0.02, 1.02))
        axis.xaxis.set_major_locator(MaxNLocator(4))
        axis.grid(alpha=0.6)
    labels = [arm.label for arm in next(iter(found.values()))]
    _legend(figure, labels, ["-"] * len(labels))
    return _svg(figure, f"profiles-{name}", "performance profiles")


@mpl.rc_context(STYLE)
def accuracy(ours: Mapping[str, Sequence[SpeedAndError]], paper: Sequence[SpeedAndError], error: str) -> str:
    """Draw errors against frames per second (Fig. 1).

    Args:
        ours: our points by table; they are named if there are few.
        paper: the points of the paper's systems.
        error: the metric.
    """
    figure = Figure(figsize=(WIDTH, 5))
    axis = figure.add_subplot()
    axis.plot(
        [point.fps for point in paper], [point.error for point in paper],
        linestyle="", marker="D", color=INK, markerfacecolor="none", label="paper, Meta Quest 3",
    )  # fmt: skip
    _names(axis, paper)
    for number, (name, points) in enumerate(ours.items()):
        axis.plot(
            [point.fps for point in points], [point.error for point in points],
            linestyle="", marker=MARKERS[number // len(SERIES) % len(MARKERS)], markersize=5, alpha=0.8,
            color=SERIES[number % len(SERIES)], label=name,
        )  # fmt: skip
    measured = {(point.fps, point.error): point for points in ours.values() for point in points}
    if len(measured) <= NAMED:
        _names(axis, measured.values())
    axis.set(xscale="log", xlabel="frames a second, CPU", ylabel=heading(error))
    axis.xaxis.set_major_formatter(ScalarFormatter())
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.grid(alpha=0.6)
    axis.legend(loc="upper left", bbox_to_anchor=(1, 1), fontsize=8)
    return _svg(figure, "accuracy", f"{error} against frames a second")


def _names(axis: Axes, points: Iterable[SpeedAndError]) -> None:
    """Write the points' names, alternately above and below, so that neighbours don't overlap."""
    for number, point in enumerate(sorted(points, key=lambda point: (point.fps, point.error))):
        place = (6, -11 if number % 2 else 5)
        axis.annotate(point.label, (point.fps, point.error), place, textcoords="offset points", fontsize=8)


@mpl.rc_context(STYLE)
def curves(name: str, panels: Mapping[str, Mapping[str, Sequence[Curve]]]) -> str:
    """Draw values by training step: a panel for each metric, a colour for each arm, a line for each run."""
    figure, axes = _panels(len(panels), 2.6 * -(-len(panels) // PANELS), sharey=False)
    labels = list(dict.fromkeys(label for arms in panels.values() for label in arms))
    colours = {label: SERIES[number % len(SERIES)] for number, label in enumerate(labels)}  # in each panel
    for axis, (metric, arms) in zip(axes, panels.items(), strict=True):
        for label, runs in arms.items():
            for curve in runs:
                axis.plot(curve.steps, curve.values, color=colours[label], linewidth=1, alpha=0.8)
        values = [value for runs in arms.values() for curve in runs for value in curve.values]
        if min(values) > 0 and max(values) > 10 * min(values):
            axis.set_yscale("log")
        axis.set(title=metric, xlabel="step")
        axis.xaxis.set_major_locator(MaxNLocator(4))
        axis.grid(alpha=0.6)
    _legend(figure, labels, ["-"] * len(labels))
    return _svg(figure, f"curves-{name}", "training curves")


def _panels(count: int, height: float, sharey: bool = True) -> tuple[Figure, list[Axes]]:
    """Make a figure with that many axes, up to PANELS side by side."""
    columns = min(count, PANELS)
    figure = Figure(figsize=(WIDTH, height + 0.5))
    axes = figure.subplots(-(-count // columns), columns, squeeze=False, sharey=sharey).ravel().tolist()
    for unused in axes[count:]:
        unused.set_visible(False)
    return figure, axes[:count]


def _bar(axis: Axes, cell: Cell, place: float, number: int) -> None:
    """Draw a difference with its interval; its mark is filled if the difference is significant."""
    effect = cell.effect
    if effect is None:
        return
    if effect.low is not None and effect.high is not None:
        axis.plot([effect.low, effect.high], [place, place], color=SERIES[number], solid_capstyle="butt")
    fill = SERIES[number] if effect.significant else "none"
    axis.plot(effect.mean, place, marker="o", color=SERIES[number], markerfacecolor=fill, markersize=5)


def _legend(figure: Figure, labels: Sequence[str], marks: Sequence[str]) -> None:
    """Draw one legend above all panels."""
    handles = [
        mpl.lines.Line2D(
            [], [],
            color=INK if mark == "D" else SERIES[number % len(SERIES)],
            marker="" if mark == "-" else mark,
            linestyle="" if mark == "D" else "-",
            markerfacecolor="none" if mark == "D" else None,
            markersize=5,
        )
        for number, mark in enumerate(marks)
    ]  # fmt: skip
    words = [_short(label) for label in labels]
    figure.legend(handles, words, loc="outside upper left", ncols=min(len(labels), 4), fontsize=8)


def _short(label: str) -> str:
    return label if len(label) <= LABEL else f"{label[: LABEL - 1]}…"


def _svg(figure: Figure, name: str, description: str) -> str:
    """Return the figure as an SVG element for the page.

    Its ids are unique in the page, it has no metadata that changes from day to day, and it uses the page's
    colours.
    """
    figure.set_layout_engine("constrained")
    file = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": name}):
        figure.savefig(file, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = file.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r' id="[A-Za-z.]*?(?:2d|3d)?_\d+"', "", text)
    for placeholder, colour in COLOURS.items():
        text = text.replace(placeholder, colour)
    return text.replace("<svg", f'<svg role="img" aria-label="{html.escape(description)}"', 1)
