"""The page of one table of kept results."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

from memmlp.common.text_formats import escape_markdown
from memmlp.report.kept_results import KeptResults
from memmlp.report.tables.flags import join_first, join_quoted
from memmlp.report.tables.measured_run import UNKNOWN
from memmlp.report.tables.statistics import Verdict
from memmlp.report.tables.table import Cell, Row, Table
from memmlp.report.tables.table_text import (
    CONFOUNDED,
    describe_branches,
    describe_power,
    explain_marks,
    format_counts,
    format_effect,
    format_mean,
    format_paper_value,
    list_remarks,
    make_caption,
    make_heading,
)
from memmlp.sweep.definition import COSTS

FILES = "tables"  # folder of the CSV files and the remarks, below the folder of the pages
MAX_REMARK = 160  # maximum length of a remark with a list of variants on a page, characters
ORIGIN = {
    "code": "commit", "torch": "torch", "hardware": "processor", "device": "device", "gpu": "GPU",
    "threads": "threads", "precision": "precision", "data": "data", "body": "body",
}  # fmt: skip
BRANCHES = {"": "branch that the paper prints", "rotation": "rotation branch", "position": "position branch"}
RATIO = "ratio"  # column of a step's time over the yardstick's time
TIME_COLUMNS = {
    "network ms": "*network ms*: features in, the network's outputs out.",
    "pose ms": "*pose ms*: from the trackers to the avatar's joints.",
    RATIO: "Yardstick: matrix products, timed in turn with the step.",
}  # explanations of columns


class KeptTable(NamedTuple):
    """The content of a page: kept results and their table.

    Attributes:
        kept: the results.
        table: the table computed from the results.
        regroup: makes the table with other clip groups, from patterns and whether each group has the same
            weight (`build_table.restrict_and_group_clips`).
        by_source: one table for each source of test clips, if there are several sources.
    """

    kept: KeptResults
    table: Table
    regroup: Callable[[Sequence[str], bool], Table]
    by_source: tuple[Table, ...] = ()

    @property
    def by_clips(self) -> dict[str, Table]:
        """The tables by the source of their test clips; "all" for all test clips."""
        names = self.kept.sources if self.by_source else ()
        return {"all": self.table, **dict(zip(names, self.by_source, strict=True))}


def make_page(name: str, source: KeptTable, frontier: bool = False) -> str:
    """Return a page: what was measured, one table of stream mode with the paper's values, and remarks; with
    `frontier`, also the picture of it."""
    table = source.table
    parts = [f"# {escape_markdown(make_caption(table))}", " ".join(_describe_table(source))]
    if frontier:
        parts.append(f"![Error against cost, with 95 % intervals]({name}_frontier.svg)")
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
    kept, table = source.kept, source.table
    counts = {"run": kept.run_count - kept.untrained_count, "untrained network": kept.untrained_count}
    runs = " and ".join(f"{count} {what}{'s' * (count != 1)}" for what, count in counts.items() if count)
    groups = max((row.groups for row in table.rows), default=0)
    tested = f", tested on clips in {groups} groups" if groups else ""
    others = join_first([f"`{one}`" for one in kept.splits if one])
    yield f"`{make_command(kept)}`{f', and again with {others}' if others else ''}: {runs}{tested}."
    if kept.splits:
        yield "Test clips of these splits are pooled."
    if marks := explain_marks(table):
        yield f"Beside the paper's differences: {marks}."
    yield from (text for metric, text in TIME_COLUMNS.items() if metric in table.metrics)
    if not table.measured_metrics:
        return
    yield f"Mode: {table.modes[0]}; {escape_markdown(describe_branches(table))}."
    if any(table.list_effects(table.modes[0])):
        verdict = "its [verdict](pages.md#verdicts), if it is not inconclusive"
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
    return make_markdown_table(["variant", *(["compared with"] if several else []), "seeds", *columns], lines)


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
    verdict = effect.verdict if effect.verdict != Verdict.INCONCLUSIVE else None
    return f"{mean} ({' '.join(filter(None, [difference.strip('*'), verdict]))})"


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
            _describe_cell(rows[one].cells[mode][metric], metric) if one in rows else "" for one in series
        ]
        values = _parse_point(point)
        lines.append([*(values.get(key, "") for key in keys), ", ".join(sorted(seeds)), *cells])
    marked = {row.series for row in table.rows if row.confounded}
    names = [f"{one} {CONFOUNDED}" if one in marked else one for one in series]
    heads = [*keys, "seeds", *names]
    return f"{make_heading(metric)}:\n\n{make_markdown_table([escape_markdown(one) for one in heads], lines)}"


def _parse_point(point: str) -> dict[str, str]:
    """Return the values of a point's keys, by the last part of each key."""
    pairs = (text.partition("=") for text in point.split(", "))
    return {key.rpartition(".")[2]: escape_markdown(value) for key, _, value in pairs}


def make_markdown_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(line)} |" for line in (heads, ["---"] * len(heads), *rows))


def _list_number_remarks(table: Table) -> list[str]:
    """Return the flags about the numbers, not those about the origin of the runs, and remarks on variants."""
    about_origin = ("code ", "made ", "digest ", "component version", "size", "networks that")
    flags = [one for one in table.flags if " differs: " not in one and not one.startswith(about_origin)]
    flags = [one.partition("; fill with: ")[0] for one in flags]  # the command is above the table
    return [*flags, *(f"{row.label}: {row.note}" for row in table.rows if row.note)]


def list_all_remarks(source: KeptTable) -> dict[str, object]:
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
