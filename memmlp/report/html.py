"""One self-contained HTML page: tables, effects, accuracy against latency, training curves, runs."""

from __future__ import annotations

import html
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from typing import Any

from memmlp.report import figures
from memmlp.report.figures import Curve, SpeedAndError
from memmlp.runs.deployment_folder import as_deployed
from memmlp.runs.identity import training_config
from memmlp.runs.metrics_log import LogRecord
from memmlp.sweep.definition import COSTS, Sweep
from memmlp.tables.effects import RunsBySeed
from memmlp.tables.error_distributions import Distribution, distributions
from memmlp.tables.formats import as_html
from memmlp.tables.measured_run import UNKNOWN, Measured, Origin
from memmlp.tables.table import Table
from memmlp.tables.table_text import better, caption, decimals
from memmlp.tables.undisturbed_times import measured_for

ERROR = "MPJRE"  # the error in Fig. 1, by Sec. 4.3
MOST_POINTS = 200  # about how many points a curve has at most


@dataclass(frozen=True)
class Chapter:
    """A sweep's table, and the finished runs behind it by arm and seed."""

    sweep: Sweep
    table: Table
    runs: Mapping[str, RunsBySeed]

    @property
    def title(self) -> str:
        """The table's caption."""
        return caption(self.table)


class ReportedRun:
    """A finished run, and the table rows that use it."""

    def __init__(self, measured: Measured):
        self.measured = measured
        self.places: list[str] = []

    @cached_property
    def config(self) -> dict[str, Any]:
        """The config keys, dotted, that can change the run's result."""
        return training_config(self.measured.run.config) if self.measured.run else {}


def page(chapters: Sequence[Chapter], published: Sequence[SpeedAndError], generated: str, commit: str) -> str:
    """Return the HTML of the page.

    Args:
        chapters: the tables with their runs.
        published: the paper's systems with frames per second and MPJRE.
        generated: when the page is made, in words.
        commit: the commit of the code that makes it.
    """
    entries, sections = _entries(chapters), _sections(chapters, published)
    template = resources.files("memmlp.report").joinpath("page.html").read_text(encoding="utf-8")
    fields = {
        "title": "Mem-MLP: measured and published",
        "generated": f"{generated}, code {commit}, {_counted(entries)}",
        "contents": _contents(sections, chapters),
        "body": "\n".join(_section(*section) for section in sections),
    }
    for name, text in fields.items():
        template = template.replace(f"{{{{{name}}}}}", text)
    return template


def fragment(
    chapters: Sequence[Chapter], published: Sequence[SpeedAndError], generated: str, commit: str
) -> str:
    """Return the report as a part of a page that has its own head and style."""
    about = f"{generated}, code {commit}, {_counted(_entries(chapters))}"
    sections = _sections(chapters, published)
    contents = f"<details><summary>Contents</summary>\n{_contents(sections, chapters)}\n</details>"
    body = "\n".join(_section(*section) for section in sections)
    return f'<h1>Measured and published</h1>\n<p class="about">{_text(about)}</p>\n{contents}\n{body}'


def _sections(
    chapters: Sequence[Chapter], published: Sequence[SpeedAndError]
) -> list[tuple[str, str, Sequence[str]]]:
    """Return the names, titles and parts of the page's sections."""
    entries = _entries(chapters)
    return [
        ("tables", "Tables", [as_html(chapter.table) for chapter in chapters]),
        ("effects", "Effects", _effects(chapters)),
        ("distributions", "Beyond the mean", _distributions(chapters)),
        ("accuracy", "Accuracy and latency", _accuracy(chapters, published)),
        ("training", "Training curves", _training(chapters)),
        ("latency", "Latency", [_latency(entries)]),
        ("runs", "Runs", [_runs(entries)]),
    ]


def published(accuracies: Sweep, latencies: Sweep) -> list[SpeedAndError]:
    """Return the systems for which the paper gives both an error and frames per second.

    The two are in different tables, in which only the beginnings of a system's names agree.
    """
    errors = {arm.label.casefold(): (arm.paper or {}).get(ERROR) for arm in accuracies.variants}
    points = []
    for arm in latencies.variants:
        fps = (arm.paper or {}).get("FPS")
        error = next((e for label, e in errors.items() if label.startswith(arm.label.casefold())), None)
        if fps is not None and error is not None:
            points.append(SpeedAndError(arm.label, fps, error))
    return points


def _entries(chapters: Sequence[Chapter]) -> list[ReportedRun]:
    """Return each finished run once per deployment, with all table rows that use it."""
    entries: dict[tuple[str, str], ReportedRun] = {}
    for chapter in chapters:
        for label, runs in chapter.runs.items():
            for seed, measured in runs.items():
                key = measured.id, str(sorted(measured.costs.items()))
                entry = entries.setdefault(key, ReportedRun(measured))
                entry.places.append(f"{chapter.sweep.name}: {label}, seed {seed}")
    return list(entries.values())


def _counted(entries: Sequence[ReportedRun]) -> str:
    """Say how many runs are in the tables; other finished runs may lack an evaluation that a table needs."""
    return f"{len({entry.measured.id for entry in entries})} finished runs stand in these tables"


def _section(name: str, title: str, parts: Sequence[str]) -> str:
    body = "\n".join(parts) or '<p class="empty">Nothing measured yet.</p>'
    return f'<section id="{name}"><h2>{title}</h2>\n{body}\n</section>'


def _contents(sections: Sequence[tuple[str, str, Sequence[str]]], chapters: Sequence[Chapter]) -> str:
    """Return the HTML of the table of contents."""
    tables = "".join(f'<li><a href="#{_text(c.sweep.name)}">{_text(c.title)}</a></li>' for c in chapters)
    items = [
        f'<li><a href="#{name}">{title}</a>{f"<ol>{tables}</ol>" if name == "tables" else ""}</li>'
        for name, title, _ in sections
    ]
    return f"<ol>{''.join(items)}</ol>"


def _effects(chapters: Iterable[Chapter]) -> list[str]:
    """Return the forest plots."""
    parts = []
    for chapter in chapters:
        svg = figures.forest(chapter.table)
        if svg:
            note = (
                f"Difference from '{chapter.table.control}', or from the arm's own control, with its 95 % "
                "interval; filled where it is significant after Holm's correction; the shaded band is the "
                "smallest effect of interest, the diamond the paper's difference. Left is better"
                f"{_but(chapter.table, 'right')}."
            )
            parts.append(_figure(chapter.title, svg, note))
    return parts


def _but(table: Table, side: str) -> str:
    """Say which of a table's metrics are better on the other side; empty if none is."""
    higher = [metric for metric in table.measured_metrics if better(metric) == "higher"]
    return f", of {', '.join(map(_text, higher))} {side}" if higher else ""


def _distributions(chapters: Iterable[Chapter]) -> list[str]:
    """Return the performance profiles, and the tables of numbers that a few clips can't dominate."""
    parts = []
    for chapter in chapters:
        found = distributions(chapter.sweep, chapter.runs, chapter.table.modes[0])
        if found:
            svg = figures.profiles(chapter.sweep.name, found)
            note = (
                f"{chapter.table.modes[0].capitalize()} mode: the fraction of all runs' test clips whose "
                "value is at most this. Further up and left is better"
                f"{_but(chapter.table, 'further down and right')}."
            )
            parts += [_figure(chapter.title, svg, note), _robust(found)]
    return parts


def _robust(found: Mapping[str, Sequence[Distribution]]) -> str:
    """Return a table of interquartile means and probabilities of improvement, with a row for each arm."""
    metrics = list(found)
    head = ["variant", *(f"{metric}: {what}" for metric in metrics for what in ("IQM", "P(better)"))]
    rows = [
        [one.label, *(word for metric in metrics for word in _robust_words(found[metric][place]))]
        for place, one in enumerate(found[metrics[0]])
    ]
    note = (
        "IQM: the mean of the middle half of all seeds and clips. P(better): how often a run of the arm has "
        "a better value than one of its control on the same clip. A clip on which a network diverged counts "
        "as worse than any value. Neither is a test."
    )
    return _rows(head, rows, note)


def _robust_words(one: Distribution) -> tuple[str, str]:
    better = "-" if one.improvement is None else f"{one.improvement:.2f}"
    return ("-" if one.middle is None else f"{one.middle:.{decimals(one.middle)}f}"), better


def _accuracy(chapters: Iterable[Chapter], paper: Sequence[SpeedAndError]) -> list[str]:
    """Return the paper's Fig. 1 with our measured points added."""
    ours = {chapter.title: _points(chapter) for chapter in chapters}
    lost = [f"'{p.label}' of {title}" for title, points in ours.items() for p in points if not _drawn(p)]
    ours = {title: [p for p in points if _drawn(p)] for title, points in ours.items()}
    ours = {title: points for title, points in ours.items() if points}
    if not ours:
        return []
    svg = figures.accuracy(ours, paper, ERROR)
    note = (
        f"{ERROR} of the rotation branch in stream mode, mean over seeds, against frames a second of one CPU "
        "core here (1000 / median ms); one point an arm. The paper's systems ran on a Meta Quest 3, on other "
        "data, and its frames a second are capped by the display at 72: the two kinds of points share axes, "
        "not conditions."
    )
    note += f" Not drawn, since a run of it diverged: {', '.join(lost)}." if lost else ""
    return [_figure(f"{ERROR} against frames a second", svg, note)]


def _drawn(point: SpeedAndError) -> bool:
    """Return whether a point has a place in the figure."""
    return math.isfinite(point.fps) and math.isfinite(point.error)


def _points(chapter: Chapter) -> list[SpeedAndError]:
    """Return each arm's mean frames per second and mean error, each of the runs that count in tables."""
    points = []
    for label, runs in chapter.runs.items():
        rates = [run.costs["FPS"] for run in measured_for("FPS", runs).values() if "FPS" in run.costs]
        values = [run.value("stream", "rotation", ERROR) for run in runs.values()]
        errors = [error for error in values if error is not None]
        if rates and errors:
            points.append(SpeedAndError(label, sum(rates) / len(rates), sum(errors) / len(errors)))
    return points


def _training(chapters: Iterable[Chapter]) -> list[str]:
    """Return the curves of loss and validation metrics by step."""
    parts = []
    for chapter in chapters:
        panels = _curves(chapter)
        if panels:
            parts.append(
                _figure(chapter.title, figures.curves(chapter.sweep.name, panels), "One line a run.")
            )
    return parts


def _curves(chapter: Chapter) -> dict[str, dict[str, list[Curve]]]:
    """Return the panels of curves: the training loss, and the table's metrics in validation.

    The metrics are those of the rotation branch.
    """
    names = [f"rotation {metric}" for metric in chapter.table.metrics if metric not in COSTS]
    wanted = {("train", "loss"): "training loss"}
    wanted |= {("val", name): f"validation: {name}" for name in names}
    logs = {
        label: [measured.run.metrics() for measured in runs.values() if measured.run]
        for label, runs in chapter.runs.items()
    }
    panels: dict[str, dict[str, list[Curve]]] = {}
    for (phase, name), title in wanted.items():
        arms = {label: [_curve(log, phase, name) for log in found] for label, found in logs.items()}
        arms = {label: [c for c in found if len(c.steps) > 1] for label, found in arms.items()}
        if any(arms.values()):
            panels[title] = {label: found for label, found in arms.items() if found}
    return panels


def _curve(log: Sequence[LogRecord], phase: str, name: str) -> Curve:
    """Return a value over the training steps, thinned out evenly if it is long; the last point is kept."""
    points = [
        (entry.step, entry.values[name]) for entry in log if entry.phase == phase and name in entry.values
    ]
    stride = max(len(points) // MOST_POINTS, 1)
    points = points[::-stride][::-1]
    return Curve([step for step, _ in points], [value for _, value in points])


def _latency(entries: Sequence[ReportedRun]) -> str:
    """Return a table of the time, work and size of each run's streaming step."""
    if not entries:
        return ""
    head = (
        "run",
        "precision",
        "median ms",
        "p95 ms",
        "whole pose, ms",
        "x yardstick",
        "parameters",
        "MMAC",
        "ONNX MB",
        "processor",
        "rows of tables",
    )
    rows = []
    for entry in entries:
        values = as_deployed(entry.measured.latency)
        numbers = [
            _number(values, key, scale, form)
            for key, scale, form in (
                ("median_ms", 1, ".2f"), ("p95_ms", 1, ".2f"), ("pose_median_ms", 1, ".2f"),
                ("ratio_to_yardstick", 1, ".2f"),
                ("parameters", 1, ",.0f"), ("macs", 1e6, ".1f"), ("onnx_bytes", 1e6, ".2f"),
            )
        ]  # fmt: skip
        origin = entry.measured.origin
        rows.append([entry.measured.id, origin.deployed, *numbers, _machine(origin), "; ".join(entry.places)])
    return _rows(
        head, rows, "One streaming step on one CPU core; the yardstick is a fixed stack of matrix products."
    )


def _machine(origin: Origin) -> str:
    """Return the machine of the times, which is not always that of the training."""
    return origin.hardware if origin.timed_on == UNKNOWN else origin.timed_on


def _number(values: Mapping[str, float], key: str, scale: float, form: str) -> str:
    return format(values[key] / scale, form) if key in values else "-"


def _runs(entries: Sequence[ReportedRun]) -> str:
    """Return a table of the runs, with the config keys whose values differ from the most common one."""
    if not entries:
        return ""
    common = _common([entry.config for entry in entries])
    rows = []
    for entry in entries:
        run, origin = entry.measured.run, entry.measured.origin
        manifest = run.manifest if run else {}
        seconds = manifest.get("seconds")
        minutes = f"{sum(seconds.values()) / 60:.1f}" if isinstance(seconds, dict) else "-"
        keys = sorted({*entry.config, *common})
        differing = [f"{k}={entry.config.get(k, '-')}" for k in keys if entry.config.get(k) != common.get(k)]
        code = origin.code + (" + changes" if origin.changed else "")
        when = str(manifest.get("started", "-"))[:16].replace("T", " ")
        known = f"{origin.data} ({origin.partial})" if origin.partial else origin.data
        row = [entry.measured.id, when, minutes, code, known, "; ".join(differing) or "-"]
        rows.append([*row, "; ".join(entry.places)])
    head = (
        "run",
        "started",
        "minutes",
        "code",
        "data",
        "config, where it is not the commonest",
        "rows of tables",
    )
    return _rows(head, rows, "")


def _common(configs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the most common value of every key."""
    common = {}
    for key in {key for config in configs for key in config}:
        values = Counter(repr(config.get(key)) for config in configs)
        word = values.most_common(1)[0][0]
        common[key] = next(config.get(key) for config in configs if repr(config.get(key)) == word)
    return common


def _rows(head: Sequence[str], rows: Sequence[Sequence[str]], note: str) -> str:
    """Return a plain table of words, with a note above it."""
    top = "".join(f'<th scope="col">{_text(word)}</th>' for word in head)
    body = "".join(f"<tr>{_row(row)}</tr>" for row in rows)
    table = f'<table class="plain"><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>'
    return f'<p>{_text(note)}</p><div class="scroll">{table}</div>'


def _row(words: Sequence[str]) -> str:
    cells = "".join(f"<td>{_text(word)}</td>" for word in words[1:])
    return f'<th scope="row"><code>{_text(words[0])}</code></th>{cells}'


def _figure(title: str, svg: str, note: str) -> str:
    caption = f"<figcaption>{_text(note)}</figcaption>"
    return f'<figure><h3>{_text(title)}</h3><div class="scroll">{svg}</div>{caption}</figure>'


def _text(text: str) -> str:
    return html.escape(text)
