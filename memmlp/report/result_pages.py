"""Pages of results: one for each table, and pages from templates that take numbers from the tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

from jinja2 import Environment, StrictUndefined, TemplateError

from memmlp.common.errors import InputError
from memmlp.report.kept_results import Kept
from memmlp.tables.formats import escaped, markdown
from memmlp.tables.measured_run import UNKNOWN, Measured
from memmlp.tables.statistics import Verdict
from memmlp.tables.table import Cell, Row, Table
from memmlp.tables.table_text import (
    MINUS,
    MISSING,
    caption,
    decimals,
    effect_words,
    number_words,
    unit,
    value_words,
    with_unit,
)

MARK = "<!-- made by: memmlp results docs -->"
ORIGIN = {
    "code": "commit", "torch": "torch", "hardware": "processor", "device": "device", "gpu": "GPU",
    "threads": "threads", "precision": "precision", "data": "data", "body": "body",
}  # fmt: skip


TURNED = {Verdict.HIGHER: Verdict.LOWER, Verdict.LOWER: Verdict.HIGHER}
"""The verdicts that change when a difference's sign is reversed."""


class KeptTable(NamedTuple):
    """The content of a page: kept results, and the table computed from them now.

    `by_source` are the tables of each source's test clips alone, if the data has several sources; `trends`
    are the effects against the sweep's scale, if it has one. `together` makes the same table with test clips
    in one group, too, that match one of some patterns alike.
    """

    kept: Kept
    table: Table
    by_source: tuple[Table, ...] = ()
    together: Callable[[Sequence[str]], Table] | None = None


def pages(sources: Mapping[str, KeptTable], templates: Mapping[str, str]) -> dict[str, str]:
    """Return the texts of all pages by file name.

    Args:
        sources: the tables by the names of their pages, without the ending.
        templates: the templates' texts by file name.

    Raises:
        InputError: for a template that names what does not exist.
    """
    made = {f"{name}.md": _table_page(source) for name, source in sorted(sources.items())}
    twice = sorted(made.keys() & templates.keys())
    if twice:
        raise InputError(
            f"{twice[0]}: a template and a table's page at once; allowed is another name for one"
        )
    words = Placeholders(sources)
    return made | {name: _filled(name, text, words) for name, text in sorted(templates.items())}


def _filled(name: str, text: str, words: Placeholders) -> str:
    """Return a page: its template, filled in. Raises InputError, which names the template."""
    environment = Environment(undefined=StrictUndefined, keep_trailing_newline=True, trim_blocks=True)
    environment.globals = words.functions()
    try:
        return f"{MARK}\n\n{environment.from_string(text).render()}"
    except TemplateError as error:
        raise InputError(f"{name}: {' '.join(str(error).split())}") from None
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def _table_page(source: KeptTable) -> str:
    tables = "\n".join(map(markdown, (source.table, *source.by_source)))
    return f"{MARK}\n\n{tables}\n{origin_words(source.kept)}\n"


def origin_words(kept: Kept) -> str:
    """Say where the runs come from, and which command makes them again."""
    counts = {"run": kept.count - kept.untrained, "untrained network": kept.untrained}
    parts = [" and ".join(f"{count} {what}{'s' * (count != 1)}" for what, count in counts.items() if count)]
    for attribute, what in ORIGIN.items():
        values = {str(getattr(run.origin, attribute)) for run in kept.every}
        # A run has several where others went on with it, or made what it builds upon; each is named once.
        values = {one for words in values for one in words.split(", ")}
        parts += [f"{what} {escaped(_listed(sorted(values - {UNKNOWN})))}"] if values - {UNKNOWN} else []
    parts += sorted({escaped(run.origin.partial) for run in kept.every if run.origin.partial})
    recipes = _recipes(kept.every)
    parts += [f"recipes {recipes}"] if recipes else []
    command = (
        f"{kept.command} --untrained".replace("sweep", "table", 1) if not counts["run"] else kept.command
    )
    return f"`{command}`: {', '.join(parts)}."


def _listed(words: Sequence[str]) -> str:
    """Return words as a list: `a`, `a and b`, `a, b and c`."""
    *rest, last = words
    return f"{', '.join(rest)} and {last}" if rest else last


def _recipes(runs: Iterable[Measured]) -> str:
    """Return the recipe versions of the components."""
    found = sorted({(name, number) for run in runs for name, number in run.origin.every_recipe.items()})
    return ", ".join(f"{escaped(name)} {number}" for name, number in found)


class Placeholders:
    """The placeholders of templates; each raises InputError for a wrong name, and says what is allowed."""

    def __init__(self, sources: Mapping[str, KeptTable]):
        self.sources = sources

    def functions(self) -> dict[str, object]:
        """Return the placeholders by the names with which templates call them."""
        names = (
            "has",
            "effect",
            "verdict",
            "value",
            "paper",
            "seen",
            "table",
            "title",
            "origin",
            "summary",
            "held",
            "way",
            "decided",
        )
        return {"names": sorted(self.sources), **{name: getattr(self, name) for name in names}}

    def has(self, name: str) -> bool:
        """Return whether there are results with that name."""
        return name in self.sources

    def effect(self, name: str, arm: str, mode: str, metric: str) -> str:
        """Return a measured difference with its interval and verdict: `+1.17 [0.40, 2.23], inconclusive`."""
        cell = self._cell(name, arm, mode, metric)
        words = effect_words(cell, metric)
        number = " ".join(word.replace("*", "") for word in words[:2])
        return f"{number}, {self.verdict(name, arm, mode, metric)}"

    def verdict(self, name: str, arm: str, mode: str, metric: str) -> str:
        """Return the verdict on an arm's difference, in a word."""
        effect = self._cell(name, arm, mode, metric).effect
        return "not measured" if effect is None or effect.verdict is None else str(effect.verdict)

    def value(self, name: str, arm: str, mode: str, metric: str) -> str:
        """Return an arm's mean and standard deviation over seeds."""
        return value_words(self._cell(name, arm, mode, metric), metric)

    def paper(self, name: str, arm: str, metric: str) -> str:
        """Return the paper's difference."""
        printed = self._cell(name, arm, self._table(name).modes[0], metric).paper_effect
        return "not printed" if printed is None else f"{printed:+.2f}".replace("-", MINUS)

    def seen(self, name: str, mode: str, metric: str, arm: str | None = None) -> str:
        """Return the smallest difference detectable with 80 % power, for one arm or for every arm."""
        if arm is None:
            least = self._table(name).detectable(mode, metric)
        else:
            effect = self._cell(name, arm, mode, metric).effect
            least = effect.detectable if effect else None
        return "unknown" if least is None else f"{number_words(least)} {unit(metric)}".rstrip()

    def table(self, name: str) -> str:
        """Return the whole table in Markdown."""
        return markdown(self._table(name)).rstrip()

    def title(self, name: str) -> str:
        """Return a table's title."""
        return escaped(caption(self._table(name)))

    def origin(self, name: str) -> str:
        """Say where a table's runs come from, and which command makes them again."""
        self._table(name)
        return origin_words(self.sources[name].kept)

    def summary(self, name: str, mode: str = "stream") -> str:
        """Return a table with a line for each arm: measured and the paper's differences, and verdicts.

        For a table without errors, return its costs beside the paper's.
        """
        table = self._table(name)
        metrics = table.measured_metrics
        if not metrics:
            return self._costs(name)
        lines = [
            f"In {mode} mode:",
            "",
            f"| variant | compared with | {' | '.join(metrics)} |",
            f"| --- | --- |{' --- |' * len(metrics)}",
        ]
        for row in table.rows:
            if row.found and row.against:
                cells = [self._summed(name, row, mode, metric) for metric in metrics]
                lines.append(f"| {escaped(row.label)} | {escaped(row.against)} | {' | '.join(cells)} |")
        return "\n".join(lines)

    def held(self, names: Sequence[str], mode: str = "stream") -> str:
        """Return which of the paper's effects hold: the counts of verdicts, and a line for each arm.

        Effects whose sign the paper prints are counted, and shown with a verdict; the others are shown as
        `-`.

        Args:
            names: the names of the tables' results.
            mode: the mode of evaluation.
        """
        rows = [(name, row) for name in names for row in self._table(name).rows if row.found and row.against]
        metrics = list(dict.fromkeys(m for name in names for m in self._table(name).measured_metrics))
        words = [[self._held(name, row, mode, metric) for metric in metrics] for name, row in rows]
        verdicts = tuple(map(str, Verdict))
        counts = Counter(word for cells in words for word in cells if word in verdicts)
        said = ", ".join(f"{word} {counts[word]}" for word in verdicts if counts[word])
        lines = [
            f"Of {counts.total()} effects with a sign in the paper, in {mode} mode: {said}.",
            "",
            f"| table | variant | compared with | {' | '.join(metrics)} |",
            f"| --- | --- | --- |{' --- |' * len(metrics)}",
        ]
        for (name, row), cells in zip(rows, words, strict=True):
            if any(cell != MISSING for cell in cells):
                number = self._table(name).number or escaped(name)
                ends = f"{escaped(row.label)} | {escaped(row.against or '')} | {' | '.join(cells)}"
                lines.append(f"| [{number}]({name}.md) | {ends} |")
        return "\n".join(lines)

    def _held(self, name: str, row: Row, mode: str, metric: str) -> str:
        """Return the verdict on an effect whose sign the paper prints; a dash for any other."""
        if metric not in self._table(name).measured_metrics:
            return MISSING
        printed = self._cell(name, row.label, mode, metric).paper_effect
        return self.verdict(name, row.label, mode, metric) if printed else MISSING

    def way(self, name: str, mode: str = "stream") -> str:
        """Return a table of how each step in a chain of arms changes each metric, and its share of the total.

        In a chain, each arm is the control of the next, and the table's control is the last arm; without a
        chain the text is empty. Shares are parts of the difference between the two ends of the chain, and are
        shown if that difference's interval does not contain 0.
        """
        table = self._table(name)
        steps = _chain(table)
        if not steps:
            return ""
        first = next(row for row in table.rows if row.label == steps[0].against)
        lines = [f"| step | {' | '.join(table.measured_metrics)} |"]
        lines += [f"| --- |{' --- |' * len(table.measured_metrics)}"]
        for row in steps:
            cells = [_share(row.cells[mode][m], first.cells[mode][m], m) for m in table.measured_metrics]
            lines.append(f"| {escaped(row.label)} | {' | '.join(map(escaped, cells))} |")
        whole = [_whole(first.cells[mode][metric]) for metric in table.measured_metrics]
        title = f"the whole way, from {escaped(first.label)}"
        return "\n".join([*lines, f"| **{title}** | {' | '.join(map(escaped, whole))} |"])

    def decided(self, name: str, *patterns: str) -> str:
        """Return how many of a table's differences are significant: `53 of 148`.

        Args:
            name: the name of the table's results.
            patterns: clips that match one alike count as one group, beside the groups of the data.
        """
        table, together = self._table(name), self.sources[name].together
        if patterns:
            if together is None:
                raise InputError(f"{name}: has no coarser groups; allowed is decided without patterns")
            table = together(patterns)
        cells = (cell for row in table.rows for metrics in row.cells.values() for cell in metrics.values())
        found = Counter(cell.effect.verdict for cell in cells if cell.effect and cell.effect.verdict)
        return f"{found.total() - found[Verdict.INCONCLUSIVE] - found[Verdict.EQUIVALENT]} of {found.total()}"

    def _costs(self, name: str) -> str:
        table = self._table(name)
        heads = [with_unit(metric) for metric in table.metrics]
        lines = [f"| variant | {' | '.join(map(escaped, heads))} |", f"| --- |{' --- |' * len(heads)}"]
        for row in (row for row in table.rows if row.found):
            costs = row.cells[table.modes[0]]
            cells = [self.value(name, row.label, table.modes[0], metric) for metric in table.metrics]
            papers = [costs[metric].paper for metric in table.metrics]
            both = [
                cell if paper is None else f"{cell}; paper {paper:.2f}"
                for cell, paper in zip(cells, papers, strict=True)
            ]
            lines.append(f"| {escaped(row.label)} | {' | '.join(both)} |")
        return "\n".join(lines)

    def _summed(self, name: str, row: Row, mode: str, metric: str) -> str:
        printed = row.cells[mode][metric].paper_effect
        paper = "" if printed is None else f"; paper {self.paper(name, row.label, metric)}"
        return escaped(f"{self.effect(name, row.label, mode, metric)}{paper}")

    def _table(self, name: str) -> Table:
        _allowed("results", name, self.sources)
        return self.sources[name].table

    def _cell(self, name: str, arm: str, mode: str, metric: str) -> Cell:
        """Return a cell of a table. Raises InputError if one of the names is wrong."""
        table = self._table(name)
        rows = {row.label: row for row in table.rows}
        _allowed(f"arm of {name}", arm, rows)
        _allowed("mode", mode, rows[arm].cells)
        _allowed(f"metric of {name}", metric, rows[arm].cells[mode])
        return rows[arm].cells[mode][metric]


def _chain(table: Table) -> list[Row]:
    """Return the arms after the chain's first, up to the table's control; each is the control of the next."""
    rows = {row.label: row for row in table.rows}
    found: list[Row] = []
    row = rows[table.control]
    while row.against in rows and row.against != table.control:
        found.insert(0, row)
        row = rows[row.against]
    return found


def _share(cell: Cell, way: Cell, metric: str) -> str:
    """Return a step's difference, its share of the chain's total, and its verdict."""
    if cell.effect is None:
        return MISSING
    words = [effect_words(cell, metric)[0].replace("*", "")]
    if way.effect is not None and (way.effect.low or 0) * (way.effect.high or 0) > 0:
        words.append(f"{round(100 * cell.effect.mean / -way.effect.mean)} %".replace("-", MINUS))
    return ", ".join([*words, str(cell.effect.verdict or "no verdict")])


def _whole(cell: Cell) -> str:
    """Return the change from an arm to its control: the reversed difference, its verdict, and the paper's."""
    if cell.effect is None:
        return MISSING
    verdict = TURNED.get(cell.effect.verdict, cell.effect.verdict) if cell.effect.verdict else "no verdict"
    printed = "" if cell.paper_effect is None else f"; paper {-cell.paper_effect:+.2f}"
    digits = 2 if cell.mean is None else decimals(cell.mean)
    return f"{-cell.effect.mean:+.{digits}f}, {verdict}{printed}".replace("-", MINUS)


def _allowed(what: str, name: str, known: Iterable[str]) -> None:
    if name not in known:
        raise InputError(f"'{name}' is no {what}; allowed are {', '.join(known) or 'none'}")
