"""The part of a sweep's page that shows its effects as lines through the cells of its axes."""

from __future__ import annotations

import math
from collections.abc import Sequence

from memmlp.sweep.definition import COMPUTE
from memmlp.tables.effects_along_axes import MODE, Bounds, Slope, Trend, Trends, TrendVerdict
from memmlp.tables.formats import escaped
from memmlp.tables.table_text import decimals, decimals_of_interval, signed, with_unit

SIGNS = {1: "higher", -1: "lower", 0: "open", None: "no verdict"}
NEAR = 0.5
"""A prediction is near if it exceeds the measured range by at most this fraction of the range, in decades."""


def scaling_section(found: Trends) -> str:
    """Return the section in Markdown: how to read it, the figure, a table of lines, what they predict."""
    parts = [f"### Effects against {escaped(_listed(found.along))}: {escaped(found.title)}"]
    parts.append("\n".join(f"- {line}" for line in _explained(found)))
    if any(trend.line for trend in found.trends):
        parts.append(f"![The effects of {escaped(found.name)} with their lines]({picture_name(found)})")
        parts += [_table(found, name) for name in found.along if _has(found, name)]
        parts.append("\n".join(f"- {line}" for line in [*_reach(found), *_readings(found)]))
    without = [trend for trend in found.trends if trend.line is None]
    words = dict.fromkeys(f"- '{escaped(trend.series)}': {escaped(trend.reason)}" for trend in without)
    return "\n\n".join([*parts, *(["No lines:\n\n" + "\n".join(words)] if words else [])]) + "\n"


def scaling_summary(found: Trends) -> str:
    """Return in Markdown what the lines show about each effect, one bullet each."""
    readings = _readings(found)
    return "\n".join(f"- {line}" for line in ([*_reach(found), *readings] if readings else ["no line yet"]))


def picture_name(found: Trends) -> str:
    """Return the name of the figure's file, which lies in the page's folder."""
    return f"{found.name}.png"


def amount(name: str, value: float) -> str:
    """Return a value on the axis of the figure as text; FLOPs get their unit."""
    return f"{power(value)} FLOP" if name == COMPUTE else f"{value:g}"


def power(value: float) -> str:
    """Return a large number with two digits, as in 5.7 · 10¹²."""
    digits, exponent = f"{value:.1e}".split("e")
    raised = str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{digits} · 10{raised}"


def bounds_words(one: Bounds) -> str:
    """Return a number with its interval, as in +0.42 (0.10 to 0.74)."""
    if not math.isfinite(one.high - one.low):
        return signed(one.mean, "+.2f")
    width = one.high - one.low
    digits = decimals_of_interval(width, decimals(width))
    low, high = (signed(number, f".{digits}f") for number in (one.low, one.high))
    return f"{signed(one.mean, f'+.{digits}f')} ({low} to {high})"


def _has(found: Trends, name: str) -> bool:
    return any(name in trend.slopes for trend in found.trends)


def _explained(found: Trends) -> list[str]:
    """Explain what the effects are, what was measured, and how the lines were made."""
    controls = sorted({trend.control for trend in found.trends})
    seeds = sorted({point.seeds for trend in found.trends for point in trend.points})
    lines = [
        f"an effect is an arm's error less that of '{escaped(_listed(controls))}' in the same cell, in "
        f"{MODE} mode: above 0 the arm is worse",
        f"measured: {found.cells} of {found.wanted} cells (arm x point of the axes)"
        + (f", {_numbers(seeds)} each" if seeds else "")
        + (
            f"; their trainings took {found.seconds / 3600:.2g} hours one after another"
            if found.seconds
            else ""
        ),
    ]
    if (ends := found.measured(COMPUTE)) is not None:
        history = "; calls without gradients, by which a rollout makes its history, are left out"
        lines.append(
            "compute: FLOPs of the matrix products of the control's training, forward and backward; "
            f"measured from {power(ends[0])} to {power(ends[1])}{history if found.own_history else ''}"
        )
    lines.append(
        "lines: random-effects regression on the logarithms, whose cells share their test clips "
        "([statistics](../statistics.md#effects-against-scale)); in brackets 95 % intervals; verdicts are "
        f"corrected by Holm over the {_slopes(found)} slopes of this page, signs of predictions over all of "
        "these"
    )
    lost = max((trend.lost for trend in found.trends), default=0)
    shared = min((trend.clips for trend in found.trends if trend.points), default=0)
    return [
        *lines,
        *(
            [f"{lost} clips that some cells lack are left out of the lines; {shared} are left"]
            if lost
            else []
        ),
    ]


def _slopes(found: Trends) -> int:
    return sum(slope.p is not None for trend in found.trends for slope in trend.slopes.values())


def _numbers(seeds: Sequence[int]) -> str:
    least, most = seeds[0], seeds[-1]
    words = str(least) if least == most else f"{least} to {most}"
    return f"{words} seed{'' if most == 1 else 's'}"


def _table(found: Trends, name: str) -> str:
    """Return the table of all slopes along one axis; that of the first axis has the effects' sizes, too."""
    first = name == found.along[0]
    ahead = found.compute if name == COMPUTE else None
    head = ["effect", "metric", "cells", f"tenfold {escaped(name)}", "verdict"]
    head += ["at the largest measured"] if first else []
    head += [f"predicted at {escaped(str(found.predict))}", "its sign"] if ahead else []
    rows = [head, ["---", "---", "---:", "---:", "---", *["---:"] * (len(head) - 5)]]
    for trend in found.trends:
        if name not in trend.slopes:
            continue
        slope = trend.slopes[name]
        row = [
            escaped(trend.series),
            escaped(with_unit(trend.metric)),
            str(len(trend.points)),
            bounds_words(slope.change),
        ]
        row += [_verdict(slope), *([bounds_words(trend.at())] if first else [])]
        if ahead and trend.predicted:
            row += [bounds_words(trend.predicted.effect), SIGNS[trend.predicted.sign]]
        rows.append(row)
    lines = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    ends = found.measured(name)
    assert ends is not None
    return f"**Against {escaped(name)}**, from {amount(name, ends[0])} to {amount(name, ends[1])}\n\n{lines}"


def _verdict(slope: Slope) -> str:
    return str(slope.verdict) if slope.verdict else "no verdict"


def _reach(found: Trends) -> list[str]:
    """Say how far the prediction is from the measured cells, and what follows from that."""
    ends = found.measured(COMPUTE)
    if found.predict is None or ends is None:
        return []
    where = f"`{found.predict}`"
    if found.compute is None:
        return [f"no compute of {where} is kept; memmlp results save counts it"]
    here = f"{where} is {power(found.compute)} FLOP"
    if ends[0] <= found.compute <= ends[1]:
        return [f"{here}, within what was measured"]
    above = found.compute > ends[1]
    times = found.compute / ends[1] if above else ends[0] / found.compute
    end = "times the largest" if above else "times below the smallest"
    beyond, span = math.log10(times), math.log10(ends[1] / ends[0])
    near = beyond <= NEAR * span
    trust = (
        "a short way, for which a straight line may do"
        if near
        else "too far to trust a straight line: the intervals hold if it goes on straight, and nothing "
        "measured here can show that it does"
    )
    factor = f"{times:.2g}" if times < 10 else f"{float(f'{times:.2g}'):,.0f}"
    return [
        f"{here}, {factor} {end} measured compute: {beyond:.1f} decades further than the "
        f"{span:.1f} that were measured, {trust}",
        *_held(found, where),
    ]


def _held(found: Trends, where: str) -> list[str]:
    """Say which other values are kept at their largest measured one in the prediction."""
    others = [name for name in found.along if name != COMPUTE and _has(found, name)]
    words = [f"`{name}={ends[1]:g}`" for name in others if (ends := found.measured(name)) is not None]
    return [f"the prediction for {where} has {_listed(words)}, the largest measured"] if words else []


def _readings(found: Trends) -> list[str]:
    """Say of each effect how it changes along the axes, and what is predicted about it."""
    lines = []
    for series in found.series:
        own = [trend for trend in found.trends if trend.series == series and trend.line is not None]
        if own:
            said = [_changes(own, name) for name in found.along if _has(found, name)]
            lines.append(f"**{escaped(series)}**: {'; '.join([*said, *_signs(found, own)])}")
    return lines


def _changes(own: Sequence[Trend], name: str) -> str:
    """Group an effect's metrics by the verdict on their slopes."""
    verdicts = [(trend.slopes[name].verdict, trend.metric) for trend in own if name in trend.slopes]
    parts = []
    for verdict in (*TrendVerdict, None):
        metrics = [metric for one, metric in verdicts if one == verdict]
        parts += [f"{verdict or 'no verdict'} in {_listed(metrics)}"] if metrics else []
    return f"against {escaped(name)} {', '.join(parts)}"


def _signs(found: Trends, own: Sequence[Trend]) -> list[str]:
    """Group an effect's metrics by their predicted sign."""
    if found.compute is None or not _has(found, COMPUTE):
        return []
    signs = [(trend.predicted.sign, trend.metric) for trend in own if trend.predicted]
    parts = []
    for sign, word in SIGNS.items():
        metrics = [metric for one, metric in signs if one == sign]
        parts += [f"{_listed(metrics)} {word}"] if metrics else []
    return [f"predicted at `{found.predict}`: {', '.join(parts)}"]


def _listed(words: Sequence[str]) -> str:
    """Return words as a list: `a`, `a and b`, `a, b and c`."""
    *rest, last = words
    return f"{', '.join(rest)} and {last}" if rest else last
