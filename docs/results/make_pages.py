"""Make the pages of results, from the results in data/ and the templates in templates/, without training.

`python docs/results/make_pages.py` writes a short page, a CSV file and remarks for each table, and a page for
each template. With --check it writes nothing, and exits with 1 if a page differs.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import itertools
import json
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from io import BytesIO
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, NamedTuple

import jinja2

from memmlp.cli.results import make_kept_table
from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write
from memmlp.common.text_formats import escape_markdown, format_csv
from memmlp.report.kept_results import KeptResults, load_kept_results
from memmlp.report.tables.flags import join_first, join_quoted
from memmlp.report.tables.measured_run import UNKNOWN
from memmlp.report.tables.statistics import Verdict
from memmlp.report.tables.table import Cell, Effect, Row, Table
from memmlp.report.tables.table_text import (
    CONFOUNDED,
    MISSING,
    add_unit,
    describe_branches,
    describe_power,
    explain_marks,
    find_unit,
    format_counts,
    format_effect,
    format_mean,
    format_paper_value,
    list_remarks,
    make_caption,
    make_heading,
)
from memmlp.sweep.definition import COSTS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HERE = Path(__file__).parent
MARK = "<!-- made by: docs/results/make_pages.py -->"
TRIALS = "budget_trials.csv"
SEARCHED = (
    "optim", "optim.lr", "optim.weight_decay", "optim.batch", "profile.scale", "data.mirror", "loss",
)  # fmt: skip
FILES = "tables"  # folder of the CSV files and the remarks, below the folder of the pages
MAX_REMARK = 160  # maximum length of a remark with a list of variants on a page, characters
ORIGIN = {
    "code": "commit", "torch": "torch", "hardware": "processor", "device": "device", "gpu": "GPU",
    "threads": "threads", "precision": "precision", "data": "data", "body": "body",
}  # fmt: skip
BRANCHES = {"": "branch that the paper prints", "rotation": "rotation branch", "position": "position branch"}
UNDECIDED = (Verdict.INCONCLUSIVE, Verdict.EQUIVALENT)
RATIO = "ratio"  # column of a step's time over the yardstick's time
TIME_COLUMNS = {
    "network ms": "*network ms*: features in, the network's outputs out.",
    "pose ms": "*pose ms*: from the trackers to the avatar's joints.",
    RATIO: "The yardstick is a fixed chain of matrix products, timed in turn with the step.",
}  # explanations of columns


Trial = Mapping[str, str]  # a line of TRIALS


class KeptTable(NamedTuple):
    """The content of a page: kept results and their table.

    Attributes:
        kept: the results.
        table: the table computed from the results.
        by_source: one table for each source of test clips, if there are several sources.
        regroup: makes the table with coarser clip groups, from patterns (`build_table.group_clips`).
    """

    kept: KeptResults
    table: Table
    by_source: tuple[Table, ...] = ()
    regroup: Callable[[Sequence[str]], Table] | None = None

    @property
    def by_clips(self) -> dict[str, Table]:
        """The tables by the source of their test clips; "all" for all test clips."""
        names = self.kept.sources if self.by_source else ()
        return {"all": self.table, **dict(zip(names, self.by_source, strict=True))}


def make_pages(
    sources: Mapping[str, KeptTable], templates: Mapping[str, str], trials: Sequence[Trial] = ()
) -> dict[str, str]:
    """Return the texts of all pages and of the files beside them, by path below the folder of the pages.

    Args:
        sources: the tables by page name, without the suffix.
        templates: the templates' texts by file name.
        trials: the trials of a search at equal compute.

    Raises:
        InputError: if a template and a table have the same page name, or a placeholder has an unknown name.
    """
    for name in sorted({f"{one}.md" for one in sources} & templates.keys()):
        raise InputError(f"{name}: a template and a table's page have the same name; rename one of them")
    made = {}
    for name, source in sorted(sources.items()):
        made[f"{name}.md"] = f"{MARK}\n\n{_make_page(name, source)}"
        made[f"{FILES}/{name}.csv"] = to_csv(source.by_clips)
    if sources:
        remarks = {name: _list_all_remarks(source) for name, source in sorted(sources.items())}
        made[f"{FILES}/remarks.json"] = json.dumps(remarks, indent=1, ensure_ascii=False) + "\n"
    placeholders = Placeholders(sources, trials).collect_functions()
    return made | {name: _fill_template(name, text, placeholders) for name, text in sorted(templates.items())}


def draw_pictures(sources: Mapping[str, KeptTable]) -> dict[str, bytes]:
    """Return the pictures of all pages by file name: frontiers, where the training compute differs."""
    tables = {name: source.table for name, source in sources.items() if has_frontier(source.table)}
    return {f"{name}_frontier.svg": draw_frontiers(table) for name, table in tables.items()}


def _make_page(name: str, source: KeptTable) -> str:
    """Return a page: what was measured, one table of stream mode with the paper's values, and remarks."""
    table = source.table
    parts = [f"# {escape_markdown(make_caption(table))}", " ".join(_describe_table(source))]
    if has_frontier(table):
        parts.append(f"![Error against compute and latency, with 95 % intervals]({name}_frontier.svg)")
    parts.append(_make_series_table(source) if _has_cells(table) else _make_short_table(source))
    if remarks := _list_number_remarks(table):
        parts.append("\n".join(f"- {shorten_remark(one)}" for one in remarks))
    content = (
        f"{' and '.join(table.modes)} mode, all branches and sources of test clips, with intervals and power"
    )
    parts.append(
        f"[All numbers]({FILES}/{name}.csv){f': {content}' if table.measured_metrics else ''}. "
        f"[Remarks]({FILES}/remarks.json): commits, machines, settings."
    )
    return "\n\n".join(parts) + "\n"


def shorten_remark(remark: str) -> str:
    """Return a remark; a long one without its list of variants, which is in the file of remarks."""
    head, listed, _ = remark.partition(": '")
    if listed and len(remark) > MAX_REMARK:
        return f"{escape_markdown(head)} ([variants]({FILES}/remarks.json))"
    return escape_markdown(remark)


def _describe_table(source: KeptTable) -> Iterator[str]:
    """Yield the sentences above a page's table."""
    kept, table = source.kept, source.table
    counts = {"run": kept.run_count - kept.untrained_count, "untrained network": kept.untrained_count}
    runs = " and ".join(f"{count} {what}{'s' * (count != 1)}" for what, count in counts.items() if count)
    groups = max((row.groups for row in table.rows), default=0)
    tested = f", tested on clips in {groups} groups" if groups else ""
    yield f"`{make_command(kept)}`: {runs}{tested}."
    if marks := explain_marks(table):
        yield f"Beside the paper's differences: {marks}."
    yield from (text for metric, text in TIME_COLUMNS.items() if metric in table.metrics)
    if not table.measured_metrics:
        return
    yield f"Mode: {table.modes[0]}; {escape_markdown(describe_branches(table))}."
    if any(table.list_effects(table.modes[0])):
        verdict = "its [verdict](pages.md#verdicts)"
        yield f"In parentheses: the difference from {_name_control(table)} and {verdict}."
        if table.comparisons:
            yield f"Verdicts are corrected for this page's {table.comparisons} comparisons."
        yield from _count_by_branch(table)
        if table.number and (power := describe_power(table, table.modes[0])):
            yield f"{power[0].upper()}{power[1:]}."
    for reason in dict.fromkeys(row.confounded for row in table.rows if row.confounded):
        labels = dict.fromkeys(row.series or row.label for row in table.rows if row.confounded == reason)
        yield escape_markdown(f"{CONFOUNDED} Confounded: {join_quoted(labels)} ({reason}).")


def _count_by_branch(table: Table) -> Iterator[str]:
    """Yield the numbers of verdicts, of effects with a sign in the paper if there are any."""
    mode = table.modes[0]
    signed = any(cell.paper_effect for *_, cell, _ in table.list_effects(mode))
    what = "effects with a sign in the paper" if signed else "differences"
    for branch in BRANCHES:
        if counts := table.count_verdicts(mode, branch=branch, signed=signed):
            head = f"In the {branch} branch" if branch else f"Of {counts.total()} {what}"
            yield f"{head}: {format_counts(counts)}."


def _name_control(table: Table) -> str:
    """Name what differences on a page are from."""
    if _has_cells(table):
        series = next(row.series for row in table.rows if row.label == table.control)
        name = f"'{escape_markdown(series)}'"
        return f"{name} in the same line, and in the column of {name} from the first line,"
    if _has_several_controls(table):
        return "the variant under 'compared with'"
    return f"'{escape_markdown(table.control)}'"


def _has_several_controls(table: Table) -> bool:
    return any(row.against not in (None, table.control) for row in table.rows)


def _has_cells(table: Table) -> bool:
    """Return whether the sweep has axes, so that several rows have one series."""
    return len({row.series for row in table.rows}) < len(table.rows)


def _make_short_table(source: KeptTable) -> str:
    """Return a table with a line for each variant, and a line with the paper's values if there are any."""
    table = source.table
    mode, several = table.modes[0], _has_several_controls(table)
    controls = {row.label: row.cells[mode] for row in table.rows}
    lines = []
    for row in (row for row in table.rows if row.found or row.is_paper_only):
        cells = [(row.cells[mode][metric], metric) for metric in table.metrics]
        label = escape_markdown(f"{row.label} {CONFOUNDED}" if row.confounded else row.label)
        head = [label, escape_markdown(row.against or "")] if several else [label]
        if row.found:
            seeds = f"{len(row.found)}/{len(row.wanted)}"
            others = controls.get(row.against or "", {})
            numbers = (_describe_cell(cell, metric, others.get(metric)) for cell, metric in cells)
            lines.append([*head, seeds, *numbers])
        if any(cell.paper is not None for cell, _ in cells):
            first = ["" if row.found else one for one in head]
            lines.append([*first, "paper", *(format_paper_value(cell, metric) for cell, metric in cells)])
    columns = [_make_column_heading(source, metric) for metric in table.metrics]
    return _make_markdown_table(
        ["variant", *(["compared with"] if several else []), "seeds", *columns], lines
    )


def _make_column_heading(source: KeptTable, metric: str) -> str:
    """Return a metric's heading, with the jitter of the true motion, and with what a ratio compares."""
    head = make_heading(metric)
    if metric == "Jitter" and (truths := _find_true_jitter(source)):
        return head.replace("]", f"; truth {' or '.join(truths)}{' by test clips' * (len(truths) > 1)}]")
    return head.replace(RATIO, "step time / yardstick's") if metric == RATIO else head


def _find_true_jitter(source: KeptTable) -> list[str]:
    """Return the jitter of the true motion, one number for each set of test clips."""
    mode = source.table.modes[0]
    branches = {row.branch for row in source.table.rows}
    values = (run.get_value(mode, branch, "GT Jitter") for run in source.kept.all_runs for branch in branches)
    return sorted({f"{value:.2f}" for value in values if value is not None})


def _describe_cell(cell: Cell, metric: str, control: Cell | None = None) -> str:
    """Return a mean, with its difference from the control and the verdict in parentheses.

    If the control was tested on fewer clips, the mean over the shared clips is added.
    """
    effect, mean = cell.effect, format_mean(cell, metric)
    if cell.mean is None or effect is None or (metric in COSTS and cell.paper is None):
        return mean
    difference, *ratio = format_effect(cell, metric)
    if metric in COSTS:
        return " ".join([mean, *ratio])
    if control and control.mean is not None and effect.clips == control.clips < cell.clips:
        mean = f"{mean}; shared clips: {control.mean + effect.mean:.2f}"
    return f"{mean} ({' '.join(filter(None, [difference.strip('*'), effect.verdict]))})"


def _make_series_table(source: KeptTable) -> str:
    """Return the first metric of a sweep with axes: a line for each point, a column for each series."""
    table = source.table
    mode, metric = table.modes[0], table.metrics[0]
    series = list(dict.fromkeys(row.series for row in table.rows))
    points: dict[str, dict[str, Row]] = {}
    for row in table.rows:
        points.setdefault(row.label.removeprefix(row.series).lstrip(", "), {})[row.series] = row
    keys = list(dict.fromkeys(key for point in points for key in _parse_point(point)))
    lines = []
    for point, rows in points.items():
        seeds = {f"{len(row.found)}/{len(row.wanted)}" for row in rows.values()}
        cells = [
            _describe_point(rows[one].cells[mode][metric], metric) if one in rows else "" for one in series
        ]
        values = _parse_point(point)
        lines.append([*(values.get(key, "") for key in keys), ", ".join(sorted(seeds)), *cells])
    marked = {row.series for row in table.rows if row.confounded}
    names = [f"{one} {CONFOUNDED}" if one in marked else one for one in series]
    heads = [*keys, "seeds", *names]
    return (
        f"{make_heading(metric)}:\n\n{_make_markdown_table([escape_markdown(one) for one in heads], lines)}"
    )


def _parse_point(point: str) -> dict[str, str]:
    """Return the values of a point's keys, by the last part of each key."""
    pairs = (text.partition("=") for text in point.split(", "))
    return {key.rpartition(".")[2]: escape_markdown(value) for key, _, value in pairs}


def _describe_point(cell: Cell, metric: str) -> str:
    """Return a mean and its difference, with the verdict unless it is inconclusive."""
    return _describe_cell(cell, metric).replace(f" {Verdict.INCONCLUSIVE})", ")")


def _make_markdown_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(line)} |" for line in (heads, ["---"] * len(heads), *rows))


def _list_number_remarks(table: Table) -> list[str]:
    """Return the flags about the numbers, not those about the origin of the runs, and remarks on variants."""
    about_origin = ("code ", "made ", "digest ", "component version", "size", "networks that")
    flags = [one for one in table.flags if " differs: " not in one and not one.startswith(about_origin)]
    flags = [one.partition("; fill with: ")[0] for one in flags]  # the command is above the table
    return [*flags, *(f"{row.label}: {row.note}" for row in table.rows if row.note)]


def _list_all_remarks(source: KeptTable) -> dict[str, object]:
    """Return everything about a table that is not a number: origin, explanations, flags and notes."""
    remarks = {clips: list_remarks(table) for clips, table in source.by_clips.items()}
    known = set(remarks["all"])
    others = {clips: [one for one in lines if one not in known] for clips, lines in remarks.items()}
    return {"command": make_command(source.kept), "origin": describe_origin(source.kept),
            "remarks": {**others, "all": remarks["all"]}}  # fmt: skip


def make_command(kept: KeptResults) -> str:
    """Return the command that repeats kept runs, or measures the same untrained networks again."""
    if kept.rounds:
        return f"{kept.command} --until-decided"
    if kept.run_count > kept.untrained_count:
        seeds = sorted({seed for by_seed in kept.runs.values() for seed in by_seed})
        return f"{kept.command} seed={','.join(map(str, seeds))}"
    return f"{kept.command} --untrained".replace("sweep", "table", 1)


def describe_origin(kept: KeptResults) -> list[str]:
    """Describe the code and the machines that made kept runs."""
    parts = []
    for attribute, what in ORIGIN.items():
        # A run has several values if several machines worked on it or on its prerequisites.
        values = {one for run in kept.all_runs for one in str(getattr(run.origin, attribute)).split(", ")}
        if known := sorted(values - {UNKNOWN, ""}):
            parts.append(f"{what} {', '.join(known)}")
    parts += sorted({run.origin.partial for run in kept.all_runs if run.origin.partial})
    versions = sorted({item for run in kept.all_runs for item in run.origin.every_version.items()})
    if versions:
        parts.append(f"component versions {', '.join(f'{name} {number}' for name, number in versions)}")
    return parts


def _fill_template(name: str, text: str, placeholders: Mapping[str, object]) -> str:
    """Render a template. Raises InputError, which names the template."""
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, keep_trailing_newline=True, trim_blocks=True
    )
    environment.globals = dict(placeholders)
    try:
        return f"{MARK}\n\n{environment.from_string(text).render()}"
    except (jinja2.TemplateError, InputError) as error:
        raise InputError(f"{name}: {' '.join(str(error).split())}") from None


class Placeholders:
    """The functions that templates can call. An unknown name raises InputError with the valid names."""

    def __init__(self, sources: Mapping[str, KeptTable], trials: Sequence[Trial]):
        self.sources, self._trials = sources, trials
        self._regrouped: dict[tuple[str, tuple[str, ...]], Table] = {}

    def collect_functions(self) -> dict[str, object]:
        """Return the functions by name, and the list `names` of all results."""
        methods = {name: getattr(self, name) for name in dir(self) if not name.startswith("_")}
        return {**methods, "names": sorted(self.sources)}

    def claims(self, names: Sequence[str], joined: str = "", mode: str = "stream") -> str:
        """Return a table with the verdicts on the paper's effects: a line for each table, a column a branch.

        Only effects with a sign in the paper count. Confounded rows count apart, after their mark.

        Args:
            names: the names of the tables' results.
            joined: a regular expression; clips with equal matches are one group in an additional last line.
            mode: the mode of evaluation.
        """
        lines = []
        for name in names:
            table = self._find_table(name)
            cells = [self._count_claims([table], mode, branch) for branch in BRANCHES]
            lines.append([f"[{escape_markdown(make_caption(table))}]({name}.md)", *cells])
        heads = ["table", *BRANCHES.values()]
        for label, pattern in {"all": "", "all, contents joined": joined}.items():
            if pattern or label == "all":
                tables = [self._find_table(name, pattern) for name in names]
                lines.append([label, *(self._count_claims(tables, mode, branch) for branch in BRANCHES)])
        return _make_markdown_table(heads, lines)

    def decisions(
        self,
        names: Sequence[str],
        verdict: str,
        mode: str = "stream",
        confounded: bool = False,
        joined: str = "",
        above_margin: bool = False,
    ) -> str:
        """Return the effects with a verdict such as `holds`, in the branch that the paper prints.

        Args:
            names: the names of the tables' results.
            verdict: the verdict.
            mode: the mode of evaluation.
            confounded: whether to list only confounded rows, instead of all other rows.
            joined: a regular expression; clips with equal matches are one group.
            above_margin: whether the paper's own effect must exceed the smallest effect of interest.
        """
        found: dict[str, list[str]] = {}
        for name in names:
            table = self._find_table(name, joined)
            for row, metric, cell, effect in table.list_effects(mode):
                small = abs(cell.paper_effect or 0) <= above_margin * table.smallest.get(metric, 0)
                if effect.verdict == verdict and not small and bool(row.confounded) == confounded:
                    found.setdefault(f"Table {table.number} '{row.label}'", []).append(metric)
        return escape_markdown("; ".join(f"{row}: {', '.join(metrics)}" for row, metrics in found.items()))

    def overview(self, *patterns: str) -> str:
        """Return a table of all pages: runs, seeds, and significant differences in the first mode.

        Args:
            patterns: regular expressions; with equal matches of a pattern, clips become one group in the
                last column.
        """
        lines, captions = [], [make_caption(one.table) for one in self.sources.values()]
        for name, source in sorted(self.sources.items()):
            if not source.table.measured_metrics:
                continue
            caption = make_caption(source.table)
            seeds = sorted({len(row.found) for row in source.table.rows if row.found})
            coarse = MISSING
            with contextlib.suppress(InputError):  # no clips to merge
                coarse = self._count_significant(self._regroup(name, patterns)) if source.regroup else MISSING
            caption = f"{caption} ({name})" if captions.count(caption) > 1 else caption
            link = f"[{escape_markdown(caption)}]({name}.md)"
            numbers = [str(source.kept.run_count), " to ".join(map(str, sorted({*seeds[:1], *seeds[-1:]})))]
            lines.append([link, *numbers, self._count_significant(source.table), coarse])
        heads = ["page", "runs", "seeds", "significant differences", "the same with contents joined"]
        return _make_markdown_table(heads, lines)

    def leaders(self, names: Sequence[str], metric: str, cost: str, mode: str = "stream") -> str:
        """Return the variants of some tables that no other one beats in both a metric and a cost."""
        known = []
        for row in (row for name in names for row in self._find_table(name).rows):
            cells = row.cells[mode]
            price = cells[cost].mean if cost in cells else row.costs.get(cost)
            if price is not None and (mean := cells[metric].mean) is not None:
                known.append((price, mean, row))
        best, texts = float("inf"), []
        for price, mean, row in sorted(known, key=lambda one: one[:2]):
            if mean < best:
                best, cell = mean, row.cells[mode][metric]
                number = f"{format_mean(cell, metric)} {find_unit(metric)}"
                texts.append(f"'{row.label}' {number} ({price:.2g})")
        return escape_markdown(join_first(texts))

    def searches(self, trials: int, tflop: float) -> str:
        """Return a table of a search at equal compute, with the best of the first trials of each network.
        Raises InputError if a trial is missing, or its compute differs from `tflop` by more than 5 %."""
        by_network: dict[str, list[Trial]] = {}
        for trial in sorted(self._trials, key=lambda one: int(one["trial"])):
            by_network.setdefault(trial["network"], []).append(trial)
        lines = []
        for network, found in by_network.items():
            if [int(one["trial"]) for one in found[:trials]] != list(range(trials)):
                raise InputError(f"{TRIALS}: {network} must have trials 0 to {trials - 1}")
            if bad := [one for one in found if not 0.95 <= float(one["tflop"]) / tflop <= 1.05]:
                raise InputError(f"{TRIALS}: {network} {bad[0]['trial']}: must have {tflop} TFLOP")
            errors = sorted(float(one["MPJPE"]) for one in found[:trials])
            best = min(found[:trials], key=lambda one: float(one["MPJPE"]))
            values = [best[column] for column in SEARCHED]
            lines.append((errors[0], [network, f"{errors[0]:.2f}", f"{median(errors):.2f}", *values]))
        heads = ["network", "best", "median", *(head.rpartition(".")[2] for head in SEARCHED)]
        return _make_markdown_table(heads, [line for _, line in sorted(lines)])

    def counted_compute(self) -> str:
        """Return the range of the trials' training compute."""
        counted = [float(trial["tflop"]) for trial in self._trials]
        return f"{min(counted):.3g} to {max(counted):.3g} TFLOP"

    def _count_claims(self, tables: Iterable[Table], mode: str, branch: str) -> str:
        counts: dict[str, Counter[Verdict]] = {"": Counter(), f"{CONFOUNDED} ": Counter()}
        for table in tables:
            for mark, found in counts.items():
                found.update(table.count_verdicts(mode, bool(mark), branch))
        return (
            "; ".join(f"{mark}{format_counts(found)}" for mark, found in counts.items() if found) or MISSING
        )

    def _count_significant(self, table: Table) -> str:
        counts = [Counter[bool](), Counter[bool]()]
        for row, *_, effect in table.list_effects(table.modes[0]):
            counts[bool(row.confounded)][effect.verdict not in UNDECIDED] += 1
        sound, apart = (f"{found[True]} of {found.total()}" for found in counts)
        return f"{sound}; {CONFOUNDED} {apart}" if counts[1] else sound

    def _find_table(self, name: str, joined: str = "") -> Table:
        if name not in self.sources:
            choices = ", ".join(sorted(self.sources)) or "none"
            raise InputError(f"'{name}': results must be one of {choices}")
        return self._regroup(name, (joined,)) if joined else self.sources[name].table

    def _regroup(self, name: str, patterns: tuple[str, ...]) -> Table:
        """Return a table with coarser clip groups, which takes seconds to compute, at most once."""
        regroup = self.sources[name].regroup
        if regroup is None:
            return self.sources[name].table
        if (name, patterns) not in self._regrouped:
            self._regrouped[name, patterns] = regroup(patterns)
        return self._regrouped[name, patterns]


# All numbers as CSV

CSV_HEADINGS = (
    "test clips", "variant", "mode", "branch", "metric", "unit", "seeds", "planned seeds", "clips", "mean",
    "sd", "low", "high", "compared with", "its branch", "difference", "difference low", "difference high",
    "p", "corrected p", "equivalence p", "verdict", "decided at seeds", "detectable", "paper",
    "paper difference", "confounded",
)  # fmt: skip


def to_csv(tables: Mapping[str, Table]) -> str:
    """Return all numbers of tables as CSV: a line for each variant, mode, branch and metric.

    Args:
        tables: the tables by the test clips that they are about.
    """
    lines = (
        [clips, *line]
        for clips, table in tables.items()
        for row in table.rows
        for line in _list_numbers(table, row)
    )
    return format_csv([CSV_HEADINGS, *lines])


def _list_numbers(table: Table, row: Row) -> Iterator[list[object]]:
    """Yield a variant's lines of CSV: its metrics, its other costs, and its effects in other branches."""
    seeds = [len(row.found), len(row.wanted)]
    other = next((one.branch for one in table.rows if one.label == row.against), "")
    for mode, cells in row.cells.items():
        for metric, cell in cells.items():
            if cell.values or cell.paper is not None:
                head = ["", ""] if metric in COSTS else [mode, row.branch]
                numbers = [cell.counted or "", cell.mean, cell.sd, cell.low, cell.high]
                yield _make_csv_line(row, [*head, metric], [*seeds, *numbers], cell.effect, other, cell)
    for name in (one for one in row.costs if one not in table.metrics):
        unit = {"tflop": "TFLOP", "seconds": "s"}.get(name, find_unit(name))
        line = [row.label, "", "", name, unit, *seeds, "", _shorten(row.costs[name])]
        yield [*line, *[""] * (len(CSV_HEADINGS) - len(line) - 1)]
    for branch, by_mode in row.branches.items():
        for mode, metric, effect in ((m, key, one) for m in table.modes for key, one in by_mode[m].items()):
            yield _make_csv_line(row, [mode, branch, metric], [*seeds, *[""] * 5], effect, branch)


def _make_csv_line(
    row: Row,
    head: Sequence[str],
    numbers: Sequence[object],
    effect: Effect | None,
    other: str,
    cell: Cell | None = None,
) -> list[object]:
    names = ("mean", "low", "high", "p", "holm", "equal", "verdict", "decided", "detectable")
    line = [row.label, *head, find_unit(head[-1]), *numbers, *((row.against, other) if effect else ("", ""))]
    line += [getattr(effect, name) if effect else "" for name in names]
    line += [cell.paper, cell.paper_effect] if cell else ["", ""]
    return [_shorten(one) for one in (*line, row.confounded)]


def _shorten(value: object) -> object:
    """Return a number with five significant digits, and an empty text for None."""
    return f"{value:.5g}" if isinstance(value, float) else "" if value is None else str(value)


# Frontiers: error against training compute and latency

COMPUTE, LATENCY = "tflop", "ms"
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
    """Return whether at least three variants have a known training compute, and it differs."""
    known = [row.costs[COMPUTE] for row in table.rows if COMPUTE in row.costs]
    return bool(table.measured_metrics) and len(known) > 2 and max(known) > MIN_RATIO * min(known)


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


def make_tables(folder: Path) -> dict[str, KeptTable]:
    """Return the tables of all kept results in a folder, by file stem."""
    if not (folder / "data").is_dir():
        raise InputError(f"{folder}/data: no such folder; memmlp results save --out {folder}/data makes it")
    tables = {}
    for path in sorted((folder / "data").glob("*.json")):
        kept = load_kept_results(path)
        sources = () if kept.rounds else kept.sources  # verdicts by seed rounds need all clips
        by_source = tuple(make_kept_table(kept, source) for source in sources)
        regroup = partial(make_kept_table, kept, None)
        tables[path.stem] = KeptTable(kept, make_kept_table(kept), by_source, regroup)
    return tables


def update(folder: Path, check: bool) -> int:
    """Write the pages that differ, and remove old ones; with `check` only list them. Return the exit code."""
    templates = {path.name: path.read_text(encoding="utf-8") for path in (folder / "templates").glob("*.md")}
    tables, trials = make_tables(folder), folder / TRIALS
    made = make_pages(
        tables, templates, list(csv.DictReader(trials.open(newline=""))) if trials.exists() else ()
    )
    paths = [*folder.glob("*.md"), *(folder / FILES).glob("*")]
    present = {str(path.relative_to(folder)): path.read_bytes().decode("utf-8", "replace") for path in paths}
    differing = [name for name, text in made.items() if present.get(name) != text]
    old = present.keys() - made.keys()
    stale = sorted(name for name in old if present[name].startswith(MARK) or name.startswith(f"{FILES}/"))
    print(f"{folder}: {len(made)} files, {len(differing)} {'differ' if check else 'written'}")
    if check:
        for name in [*differing, *stale]:
            print(f"{folder / name}: differs from the kept results; make it again", file=sys.stderr)
        return int(bool(differing or stale))
    (folder / FILES).mkdir(exist_ok=True)
    for name in differing:
        atomic_write(folder / name, made[name])
    for name, picture in draw_pictures(tables).items():  # its bytes differ between matplotlib's versions
        if name.replace("_frontier.svg", ".md") in differing or not (folder / name).exists():
            atomic_write(folder / name, picture)
    for name in stale:
        (folder / name).unlink()
    return 0


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if a page differs")
    parser.add_argument("--folder", type=Path, default=HERE, help="folder of the pages, data and templates")
    return parser


if __name__ == "__main__":
    arguments = parser().parse_args()
    sys.exit(update(arguments.folder, arguments.check))
