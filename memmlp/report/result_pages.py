"""Pages of results: one for each table, and pages from templates that take numbers from the tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

from memmlp.common.errors import InputError, import_optional
from memmlp.report.kept_results import Kept
from memmlp.report.tables.measured_run import UNKNOWN
from memmlp.report.tables.statistics import Verdict
from memmlp.report.tables.table import Cell, Row, Table
from memmlp.report.tables.table_text import (
    MINUS,
    MISSING,
    add_unit,
    count_decimals,
    escape_markdown,
    find_unit,
    format_effect,
    format_number,
    format_value,
    make_caption,
    to_markdown,
)

MARK = "<!-- made by: memmlp results docs -->"
ORIGIN = {
    "code": "commit", "torch": "torch", "hardware": "processor", "device": "device", "gpu": "GPU",
    "threads": "threads", "precision": "precision", "data": "data", "body": "body",
}  # fmt: skip
REVERSED = {Verdict.HIGHER: Verdict.LOWER, Verdict.LOWER: Verdict.HIGHER}


class KeptTable(NamedTuple):
    """The content of a page: kept results, and the table computed from them now.

    Attributes:
        kept: the results.
        table: their table.
        by_source: the tables of each source's test clips alone, if the data has several sources.
        regroup: makes the same table with test clips that match the same text of a pattern in one group.
    """

    kept: Kept
    table: Table
    by_source: tuple[Table, ...] = ()
    regroup: Callable[[Sequence[str]], Table] | None = None


def make_pages(sources: Mapping[str, KeptTable], templates: Mapping[str, str]) -> dict[str, str]:
    """Return the texts of all pages by file name.

    Args:
        sources: the tables by the names of their pages, without the ending.
        templates: the templates' texts by file name.

    Raises:
        InputError: for a template with the name of a table's page, or with an unknown name in a placeholder.
    """
    pages = {}
    for name, source in sorted(sources.items()):
        tables = "\n".join(map(to_markdown, (source.table, *source.by_source)))
        pages[f"{name}.md"] = f"{MARK}\n\n{tables}\n{describe_origin(source.kept)}\n"
    for name in sorted(pages.keys() & templates.keys()):
        raise InputError(f"{name}: a template and a table's page have the same name; rename one of them")
    placeholders = Placeholders(sources).functions()
    return pages | {name: _fill(name, text, placeholders) for name, text in sorted(templates.items())}


def _fill(name: str, text: str, placeholders: Mapping[str, object]) -> str:
    """Return a page: its template, filled in. Raises InputError, which names the template."""
    jinja2 = import_optional("jinja2", "plots", name)
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, keep_trailing_newline=True, trim_blocks=True
    )
    environment.globals = dict(placeholders)
    try:
        return f"{MARK}\n\n{environment.from_string(text).render()}"
    except (jinja2.TemplateError, InputError) as error:
        raise InputError(f"{name}: {' '.join(str(error).split())}") from None


def describe_origin(kept: Kept) -> str:
    """Return the command that makes kept runs again, and where they come from, in words."""
    counts = {"run": kept.count - kept.untrained, "untrained network": kept.untrained}
    parts = [" and ".join(f"{count} {what}{'s' * (count != 1)}" for what, count in counts.items() if count)]
    for attribute, what in ORIGIN.items():
        # A run has several values if several machines worked on it or on its prerequisites.
        values = {one for run in kept.every for one in str(getattr(run.origin, attribute)).split(", ")}
        *others, last = sorted(values - {UNKNOWN}) or [""]
        if last:
            parts.append(f"{what} {escape_markdown(' and '.join(filter(None, [', '.join(others), last])))}")
    parts += sorted({escape_markdown(run.origin.partial) for run in kept.every if run.origin.partial})
    versions = sorted({item for run in kept.every for item in run.origin.every_version.items()})
    if versions:
        parts.append(
            "component versions "
            + ", ".join(f"{escape_markdown(name)} {number}" for name, number in versions)
        )
    command = kept.command
    if not counts["run"]:
        command = f"{command} --untrained".replace("sweep", "table", 1)
    return f"`{command}`: {', '.join(parts)}."


class Placeholders:
    """The placeholders of templates; each raises InputError for a wrong name, and lists the right ones."""

    def __init__(self, sources: Mapping[str, KeptTable]):
        self.sources = sources

    def functions(self) -> dict[str, object]:
        """Return the placeholders by the names with which templates call them."""
        methods = {name: getattr(self, name) for name in dir(self) if not name.startswith("_")}
        return {**methods, "names": sorted(self.sources)}

    def has(self, name: str) -> bool:
        """Return whether there are results with that name."""
        return name in self.sources

    def title(self, name: str) -> str:
        """Return a table's title."""
        return escape_markdown(make_caption(self._table(name)))

    def origin(self, name: str) -> str:
        """Return where a table's runs come from, and which command makes them again."""
        self._table(name)
        return describe_origin(self.sources[name].kept)

    def effect(self, name: str, variant: str, mode: str, metric: str) -> str:
        """Return a measured difference with its interval and verdict: `+1.17 [0.40, 2.23], holds`."""
        words = format_effect(self._cell(name, variant, mode, metric), metric)
        number = " ".join(word.replace("*", "") for word in words[:2])
        return f"{number}, {self.verdict(name, variant, mode, metric)}"

    def verdict(self, name: str, variant: str, mode: str, metric: str) -> str:
        """Return the verdict on a variant's difference, in a word."""
        effect = self._cell(name, variant, mode, metric).effect
        return "not measured" if effect is None or effect.verdict is None else str(effect.verdict)

    def value(self, name: str, variant: str, mode: str, metric: str) -> str:
        """Return a variant's mean and standard deviation over seeds."""
        return format_value(self._cell(name, variant, mode, metric), metric)

    def detectable(self, name: str, mode: str, metric: str, variant: str) -> str:
        """Return the smallest difference of a variant that is detectable with 80 % power."""
        effect = self._cell(name, variant, mode, metric).effect
        least = effect.detectable if effect else None
        return "unknown" if least is None else f"{format_number(least)} {find_unit(metric)}".rstrip()

    def summary(self, name: str, mode: str = "stream") -> str:
        """Return a table with a line for each variant: measured and the paper's differences, and verdicts.

        For a table without errors, return its costs beside the paper's.
        """
        table, shown = self._table(name), [row for row in self._table(name).rows if row.found]
        if metrics := table.measured_metrics:
            rows = [
                [row.label, row.against, *(self._compare(name, row, mode, metric) for metric in metrics)]
                for row in shown
                if row.against
            ]
            return f"In {mode} mode:\n\n{_markdown(['variant', 'compared with', *metrics], rows)}"
        costs = [row.cells[table.modes[0]] for row in shown]
        rows = [
            [row.label, *(_describe_cost(cells[metric], metric) for metric in table.metrics)]
            for row, cells in zip(shown, costs, strict=True)
        ]
        return _markdown(["variant", *map(add_unit, table.metrics)], rows)

    def _compare(self, name: str, row: Row, mode: str, metric: str) -> str:
        printed = row.cells[mode][metric].paper_effect
        paper = "" if printed is None else f"; paper {printed:+.2f}".replace("-", MINUS)
        return f"{self.effect(name, row.label, mode, metric)}{paper}"

    def held(self, names: Sequence[str], mode: str = "stream") -> str:
        """Return which of the paper's effects hold: the counts of verdicts, and a line for each variant.

        Effects whose sign the paper prints are counted, and shown with a verdict; the others are shown as
        `-`.

        Args:
            names: the names of the tables' results.
            mode: the mode of evaluation.
        """
        metrics = list(dict.fromkeys(m for name in names for m in self._table(name).measured_metrics))
        rows, counts = [], Counter[str]()
        for name in names:
            table = self._table(name)
            for row in (row for row in table.rows if row.found and row.against):
                cells = [
                    self.verdict(name, row.label, mode, metric)
                    if metric in table.measured_metrics and row.cells[mode][metric].paper_effect
                    else MISSING
                    for metric in metrics
                ]
                counts.update(cells)
                if set(cells) != {MISSING}:
                    link = f"[{table.number or name}]({name}.md)"
                    rows.append([link, row.label, row.against or "", *cells])
        verdicts = {str(verdict): counts[str(verdict)] for verdict in Verdict}
        words = ", ".join(f"{verdict} {count}" for verdict, count in verdicts.items() if count)
        total = f"Of {sum(verdicts.values())} effects with a sign in the paper, in {mode} mode: {words}."
        return f"{total}\n\n{_markdown(['table', 'variant', 'compared with', *metrics], rows)}"

    def steps(self, name: str, mode: str = "stream") -> str:
        """Return a table of how each step in a chain of variants changes each metric, and its share.

        In a chain, each variant is the control of the next, and the table's control is the last one; without
        a chain the text is empty. Shares are parts of the difference between the two ends of the chain, and
        are shown if that difference's interval excludes 0.
        """
        table = self._table(name)
        by_label = {row.label: row for row in table.rows}
        chain = [by_label[table.control]]
        while (against := chain[0].against) in by_label and against != table.control:
            chain.insert(0, by_label[against])
        if len(chain) < 2:
            return ""
        first, *steps = chain
        metrics = table.measured_metrics
        rows = [
            [row.label, *(_share(row.cells[mode][one], first.cells[mode][one], one) for one in metrics)]
            for row in steps
        ]
        total = f"total, from {first.label}"
        rows.append([total, *(_reverse(first.cells[mode][metric]) for metric in metrics)])
        return _markdown(["step", *metrics], rows)

    def decided(self, name: str, *patterns: str) -> str:
        """Return how many of a table's differences are significant: `53 of 148`.

        Args:
            name: the name of the table's results.
            patterns: test clips that match the same text of a pattern are one group.
        """
        table, regroup = self._table(name), self.sources[name].regroup
        if patterns:
            if regroup is None:
                raise InputError(f"{name}: its clips cannot be regrouped; use decided without patterns")
            table = regroup(patterns)
        cells = (cell for row in table.rows for metrics in row.cells.values() for cell in metrics.values())
        found = Counter(cell.effect.verdict for cell in cells if cell.effect and cell.effect.verdict)
        return f"{found.total() - found[Verdict.INCONCLUSIVE] - found[Verdict.EQUIVALENT]} of {found.total()}"

    def _table(self, name: str) -> Table:
        _check("results", name, self.sources)
        return self.sources[name].table

    def _cell(self, name: str, variant: str, mode: str, metric: str) -> Cell:
        """Return a cell of a table. Raises InputError if one of the names is wrong."""
        rows = {row.label: row for row in self._table(name).rows}
        _check(f"variant of {name}", variant, rows)
        _check("mode", mode, rows[variant].cells)
        _check(f"metric of {name}", metric, rows[variant].cells[mode])
        return rows[variant].cells[mode][metric]


def _markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; cells are escaped, unless they are links."""
    cells = [
        [cell if cell and cell.endswith(".md)") else escape_markdown(cell or "") for cell in row]
        for row in rows
    ]
    lines = [list(map(escape_markdown, heads)), ["---"] * len(heads), *cells]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _describe_cost(cell: Cell, metric: str) -> str:
    return format_value(cell, metric) + ("" if cell.paper is None else f"; paper {cell.paper:.2f}")


def _share(step: Cell, total: Cell, metric: str) -> str:
    """Return a step's difference, its share of the chain's total, and its verdict."""
    if step.effect is None:
        return MISSING
    words = [format_effect(step, metric)[0].replace("*", "")]
    if total.effect is not None and (total.effect.low or 0) * (total.effect.high or 0) > 0:
        words.append(f"{round(100 * step.effect.mean / -total.effect.mean)} %".replace("-", MINUS))
    return ", ".join([*words, str(step.effect.verdict or "no verdict")])


def _reverse(cell: Cell) -> str:
    """Return the change from a variant to its control: its reversed difference and verdict."""
    if cell.effect is None:
        return MISSING
    verdict = REVERSED.get(cell.effect.verdict, cell.effect.verdict) if cell.effect.verdict else "no verdict"
    printed = "" if cell.paper_effect is None else f"; paper {-cell.paper_effect:+.2f}"
    digits = 2 if cell.mean is None else count_decimals(cell.mean)
    return f"{-cell.effect.mean:+.{digits}f}, {verdict}{printed}".replace("-", MINUS)


def _check(what: str, name: str, known: Iterable[str]) -> None:
    if name not in known:
        raise InputError(f"'{name}': not a {what}; must be one of {', '.join(known) or 'none'}")
