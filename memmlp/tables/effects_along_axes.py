"""The effects of a sweep with axes, as lines through its cells, against compute and the other axes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from memmlp.sweep.definition import COMPUTE, COSTS, Arm, Sweep
from memmlp.tables.effects import Paired, RunsBySeed, control_arm, paired, with_existing_branches
from memmlp.tables.statistics import holm, paired_effects
from memmlp.tables.statistics.effect_regression import Estimate, FittedLine, fit
from memmlp.tables.statistics.paired_differences import LEVEL
from memmlp.tables.table import Key

MODE = "stream"
OWN_HISTORY = "rollout.own_predictions"
"""A component that also calls the network without gradients. The count of compute lacks these calls."""


class TrendVerdict(StrEnum):
    """What may be claimed about how an effect changes along the axes.

    All but NONE have a slope that differs significantly from 0. An effect TURNS if its signs at the two ends
    are certain and opposite, RISES or FALLS if its sign is certain at neither end, and otherwise GROWS or
    FADES, by its size at the ends.
    """

    GROWS = "grows"
    FADES = "fades"
    TURNS = "changes its sign"
    RISES = "rises"
    FALLS = "falls"
    NONE = "no trend seen"


@dataclass(frozen=True)
class Bounds:
    """A number with its 95 % interval."""

    mean: float
    low: float
    high: float

    @property
    def sign(self) -> int:
        """1 or -1 if the interval excludes 0, else 0."""
        return (self.low > 0) - (self.high < 0)


@dataclass(frozen=True)
class EffectOfCell:
    """The effect measured in one cell.

    Attributes:
        cell: the overrides of the cell.
        values: the cell's values on the axes, by name.
        effect: the mean difference, with an interval over clips, and over seeds if there are several.
        seeds: the number of seeds.
    """

    cell: tuple[str, ...]
    values: Mapping[str, float]
    effect: Bounds
    seeds: int


@dataclass(frozen=True)
class Slope:
    """How an effect changes when the value on an axis grows tenfold.

    Attributes:
        change: the change, with its interval.
        p: its p-value, corrected over all slopes of the sweep; None if there is none.
        verdict: what may be claimed about it; None without a p-value.
    """

    change: Bounds
    p: float | None
    verdict: TrendVerdict | None


@dataclass(frozen=True)
class EffectPrediction:
    """The effect that one more cell would show elsewhere, if the line continues straight.

    Attributes:
        effect: the effect, with its interval.
        sign: 1 or -1 where it is above or below 0 after a correction over all predictions of the sweep, else
            0; None if nothing can be said about it.
    """

    effect: Bounds
    sign: int | None


@dataclass(frozen=True)
class Trend:
    """An effect in a metric, and the line through it.

    Attributes:
        series: the arm's label in the file.
        control: the label of the arm's control.
        metric: the metric.
        points: the measured cells.
        clips: how many test clips all cells share.
        lost: how many more clips only some of the cells have.
        varied: the axes on which the cells differ, which are the names of the line's slopes.
        line: the line; None if there is none, and `reason` says why.
        slopes: the line's slopes by name.
        reason: why there is no line; empty if there is one.
        predicted: the effect predicted at the sweep's compute for predictions; None without such a compute,
            or without a line against compute.
    """

    series: str
    control: str
    metric: str
    points: tuple[EffectOfCell, ...]
    clips: int
    lost: int
    varied: tuple[str, ...]
    line: FittedLine | None
    slopes: Mapping[str, Slope]
    reason: str = ""
    predicted: EffectPrediction | None = None

    @property
    def most(self) -> dict[str, float]:
        """The largest measured value of each axis on which the cells differ, by name."""
        return {name: max(point.values[name] for point in self.points) for name in self.varied}

    def at(self, values: Mapping[str, float] | None = None, another: bool = False) -> Bounds:
        """Return the line at values by name; values that are not given are the largest measured ones.

        Args:
            values: the values on the axes.
            another: whether the interval is for one more cell at these values (see `FittedLine.at`).
        """
        return _bounds(self.curve([values or {}], another))[0]

    def curve(self, values: Sequence[Mapping[str, float]], another: bool = False) -> Estimate:
        """Return the line at several values; see `at`."""
        assert self.line is not None
        most = self.most
        rows = [[1.0, *(math.log10(one.get(name, most[name])) for name in self.varied)] for one in values]
        return self.line.at(np.array(rows), another=another)


@dataclass(frozen=True)
class Trends:
    """All effects of a sweep against the axes of its scale.

    Attributes:
        name, title: the sweep's name and title.
        along: the axes against which they are shown; the first is a figure's axis.
        trends: the effects, series by series and metric by metric.
        cells: how many cells were measured, counted for each arm.
        wanted: how many cells the sweep has.
        predict: the overrides whose compute the effects are predicted for; None for none.
        compute: that compute, FLOPs; None if it is not known.
        seconds: the total duration of the trainings.
        own_history: whether controls were trained on their own predictions, made by calls without gradients,
            which compute leaves out.
    """

    name: str
    title: str
    along: tuple[str, ...]
    trends: tuple[Trend, ...]
    cells: int
    wanted: int
    predict: str | None
    compute: float | None
    seconds: float
    own_history: bool = False

    @property
    def series(self) -> tuple[str, ...]:
        """The arms whose effects these are, in the sweep's order."""
        return tuple(dict.fromkeys(trend.series for trend in self.trends))

    @property
    def metrics(self) -> tuple[str, ...]:
        """The metrics, in the sweep's order."""
        return tuple(dict.fromkeys(trend.metric for trend in self.trends))

    def measured(self, name: str) -> tuple[float, float] | None:
        """Return the least and the largest measured value of one of `along`; None if there are none."""
        every = [
            point.values[name] for trend in self.trends for point in trend.points if name in point.values
        ]
        return (min(every), max(every)) if every else None


def trends(
    sweep: Sweep, runs: Mapping[str, RunsBySeed], predicted: Mapping[str, float] | None = None
) -> Trends:
    """Return the effects of a sweep against its scale, in stream mode.

    Args:
        sweep: the sweep, which has a `scale`.
        runs: the finished runs of every runnable arm, by seed.
        predicted: the FLOPs at which a prediction is made, by its overrides as one line.
    """
    assert sweep.scale is not None
    pairs = paired(with_existing_branches(sweep, runs), runs, (MODE,))
    metrics = [metric for metric in sweep.metrics if metric not in COSTS]
    series = list(dict.fromkeys(arm.series for arm, _ in in_cells(sweep)))
    found = [_trend(sweep, runs, pairs, name, metric) for name in series for metric in metrics]
    words = " ".join(sweep.scale.predict) or None
    compute = (predicted or {}).get(words or "")
    every = {run.id: run for seeds in runs.values() for run in seeds.values()}
    controls = [run for _, other in in_cells(sweep) for run in runs.get(other.label, {}).values()]
    return Trends(
        name=sweep.name,
        title=sweep.title,
        along=sweep.scale.along,
        trends=tuple(_predicted(_judged(found), compute)),
        cells=sum(bool(runs.get(arm.label)) for arm in sweep.runnable()),
        wanted=len(sweep.runnable()),
        predict=words,
        compute=compute,
        seconds=sum(run.training.get("seconds", 0.0) for run in every.values()),
        own_history=any(OWN_HISTORY in run.origin.recipes for run in controls),
    )


def in_cells(sweep: Sweep) -> list[tuple[Arm, Arm]]:
    """Return the arms that are compared within their cell, each with its control."""
    found = [(arm, control_arm(sweep, arm)) for arm in sweep.runnable() if arm.cell]
    return [(arm, other) for arm, other in found if other is not None and other.cell == arm.cell]


def _trend(
    sweep: Sweep, runs: Mapping[str, RunsBySeed], pairs: Mapping[Key, Paired], series: str, metric: str
) -> Trend:
    """Return the trend of an arm's effect in a metric, whose slopes have no verdicts yet."""
    assert sweep.scale is not None
    own = [(arm, other) for arm, other in in_cells(sweep) if arm.series == series]
    cells = _cells(sweep, runs, {arm.label: pairs.get(Key(arm.label, MODE, metric)) for arm, _ in own}, own)
    differences, groups, lost = _shared([cell.pair for cell in cells])
    values = [cell.values for cell in cells]
    varied = tuple(name for name in sweep.scale.along if len({one.get(name) for one in values}) > 1)
    reason, line = _reason(sweep.scale.along, values, varied, differences) or _diverged(cells), None
    if not reason:
        x = np.array([[1.0, *(math.log10(one[name]) for name in varied)] for one in values])
        line = fit(differences, x, groups)
        few = f"{len(cells)} cells are too few, or too alike, for a line of {1 + len(varied)} coefficients"
        reason = "" if line else few
    return Trend(
        series=series,
        control=own[0][1].series,
        metric=metric,
        points=tuple(map(_point, cells)),
        clips=differences.shape[1],
        lost=lost,
        varied=varied,
        line=line,
        slopes=_slopes(line, varied) if line else {},
        reason=reason,
    )


class _Cell(NamedTuple):
    """A measured cell: an arm, its values on the axes, and its differences from its control."""

    arm: Arm
    values: Mapping[str, float]
    pair: Paired


def _cells(
    sweep: Sweep,
    runs: Mapping[str, RunsBySeed],
    pairs: Mapping[str, Paired | None],
    own: Sequence[tuple[Arm, Arm]],
) -> list[_Cell]:
    """Return the measured cells of a series; cells with the same runs are merged."""
    found: dict[tuple[frozenset[str], frozenset[str]], _Cell] = {}
    for arm, other in own:
        pair = pairs[arm.label]
        if pair is not None:
            ids = (_ids(runs[arm.label]), _ids(runs[other.label]))
            found.setdefault(ids, _Cell(arm, _values(sweep, arm, runs[other.label]), pair))
    return list(found.values())


def _slopes(line: FittedLine, varied: Sequence[str]) -> dict[str, Slope]:
    """Return a line's slopes by name, with uncorrected p-values."""
    estimates = {name: line.slope(number) for number, name in enumerate(varied, 1)}
    return {name: Slope(_bounds(one)[0], float(one.p[0]), None) for name, one in estimates.items()}


def _ids(runs: RunsBySeed) -> frozenset[str]:
    return frozenset(run.id for run in runs.values())


def _values(sweep: Sweep, arm: Arm, control: RunsBySeed) -> dict[str, float]:
    """Return a cell's values for the scale's keys: numbers in its overrides, and its compute."""
    assert sweep.scale is not None
    words = dict(word.split("=", 1) for word in arm.cell)
    found = {name: float(words[name]) for name in sweep.scale.along if name in words}
    flops = [run.training["flops"] for run in control.values() if "flops" in run.training]
    return found | ({COMPUTE: float(np.mean(flops))} if COMPUTE in sweep.scale.along and flops else {})


def _reason(
    along: Sequence[str],
    values: Sequence[Mapping[str, float]],
    varied: Sequence[str],
    differences: np.ndarray,
) -> str:
    """Say why there can be no line; empty if there may be one."""
    if not values:
        return "no cell is measured"
    if any(name not in one for one in values for name in along):
        return "the compute of some cells is not kept; memmlp results save counts it"
    if not differences.size:
        return "its cells share no test clip"
    return "" if along[0] in varied else f"all cells have the same {along[0]}"


def _diverged(cells: Sequence[_Cell]) -> str:
    """Name the cells in which a network diverged on a test clip, as no line goes through what is left."""
    names = [" ".join(cell.arm.cell) for cell in cells if cell.pair.diverged]
    return f"a network diverged on a test clip of {', '.join(names)}" if names else ""


def _point(cell: _Cell) -> EffectOfCell:
    found = paired_effects(cell.pair.matrix[None], cell.pair.groups)
    effect = Bounds(float(found.mean[0]), float(found.low[0]), float(found.high[0]))
    return EffectOfCell(cell.arm.cell, cell.values, effect, len(cell.pair.matrix))


def _shared(pairs: Sequence[Paired]) -> tuple[np.ndarray, np.ndarray, int]:
    """Return all cells' means over seeds on the clips that the cells share.

    Returns:
        Differences (K, C), the clips' groups (C,), and how many further clips only some cells have.
    """
    takes = {clip: take for pair in pairs for clip, take in zip(pair.clips, pair.group_names, strict=True)}
    rows = [dict(zip(pair.clips, pair.matrix.mean(0), strict=True)) for pair in pairs]
    clips = [clip for clip in takes if all(clip in row for row in rows)]
    differences = np.array([[row[clip] for clip in clips] for row in rows]).reshape(len(pairs), len(clips))
    return differences, np.array([takes[clip] for clip in clips], dtype=str), len(takes) - len(clips)


def _judged(found: Sequence[Trend]) -> list[Trend]:
    """Return the trends with verdicts on their slopes, corrected by Holm over all of them."""
    places = [(number, name) for number, trend in enumerate(found) for name in trend.slopes]
    corrected = holm(np.array([found[number].slopes[name].p for number, name in places], float))
    slopes: list[dict[str, Slope]] = [{} for _ in found]
    for (number, name), p in zip(places, corrected, strict=True):
        trend = found[number]
        known = not math.isnan(p)
        verdict = _verdict(trend, name, p) if known else None
        change = trend.slopes[name].change
        slopes[number][name] = Slope(change, float(p) if known else None, verdict)
    return [replace(trend, slopes=own) for trend, own in zip(found, slopes, strict=True)]


def _predicted(found: Sequence[Trend], compute: float | None) -> list[Trend]:
    """Return the trends with their predictions, whose signs are corrected by Holm over all of them."""

    def there(trend: Trend) -> Estimate | None:
        ahead = compute is not None and COMPUTE in trend.slopes
        return trend.curve([{COMPUTE: float(compute or 0)}], another=True) if ahead else None

    estimates = [there(trend) for trend in found]
    corrected = holm(np.array([math.nan if one is None else one.p[0] for one in estimates]))
    signs = [None if math.isnan(p) else int(p <= LEVEL) for p in corrected]
    return [
        trend
        if one is None
        else replace(trend, predicted=EffectPrediction(_bounds(one)[0], _signed(sign, float(one.mean[0]))))
        for trend, one, sign in zip(found, estimates, signs, strict=True)
    ]


def _signed(sure: int | None, mean: float) -> int | None:
    return None if sure is None else sure * (1 if mean > 0 else -1)


def _verdict(trend: Trend, name: str, p: float) -> TrendVerdict:
    """Return what may be claimed about a slope, from the line's signs that are certain at both ends."""
    if p > LEVEL:
        return TrendVerdict.NONE
    every = [point.values[name] for point in trend.points]
    first, last = (trend.at({name: value}) for value in (min(every), max(every)))
    if not first.sign and not last.sign:
        return TrendVerdict.RISES if last.mean > first.mean else TrendVerdict.FALLS
    if first.sign * last.sign < 0:
        return TrendVerdict.TURNS
    return TrendVerdict.GROWS if abs(last.mean) > abs(first.mean) else TrendVerdict.FADES


def _bounds(estimate: Estimate) -> list[Bounds]:
    ends = zip(estimate.mean, estimate.low, estimate.high, strict=True)
    return [Bounds(*map(float, numbers)) for numbers in ends]
