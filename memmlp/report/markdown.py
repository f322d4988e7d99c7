"""Pages of results: one a table, and templates that take numbers and verdicts from the tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from jinja2 import Environment, StrictUndefined, TemplateError

from memmlp.common.errors import InputError
from memmlp.report.claims import claims
from memmlp.report.store import Kept
from memmlp.statistics import Verdict
from memmlp.tables.formats import escaped, markdown
from memmlp.tables.grid import MINUS, MISSING, caption, effect_words, number_words, unit, value_words
from memmlp.tables.measured import UNKNOWN, Measured
from memmlp.tables.table import Cell, Row, Table

MARK = "<!-- made by: memmlp results docs -->"
ORIGIN = {
    "code": "commit", "torch": "torch", "hardware": "processor", "device": "device", "gpu": "GPU",
    "threads": "threads", "precision": "precision", "data": "data", "body": "body",
}  # fmt: skip


TURNED = {Verdict.HIGHER: Verdict.LOWER, Verdict.LOWER: Verdict.HIGHER}
"""The verdict on a difference that is turned round; the others stay."""


class KeptTable(NamedTuple):
    """What a page is made of: results that were kept, and the table that they come to today."""

    kept: Kept
    table: Table


def pages(sources: Mapping[str, KeptTable], templates: Mapping[str, str]) -> dict[str, str]:
    """The texts of all pages by file name.

    Args:
        sources: by name of the table's page, without ending. templates: texts by file name.

    Raises InputError for a template that has a hand-written claim of an effect, or names what is not there.
    """
    made = {f"{name}.md": _table_page(source) for name, source in sorted(sources.items())}
    twice = sorted(made.keys() & templates.keys())
    if twice:
        raise InputError(
            f"{twice[0]}: a template and a table's page at once; allowed is another name for one"
        )
    words = Words(sources)
    return made | {name: _filled(name, text, words) for name, text in sorted(templates.items())}


def check_claims(name: str, text: str) -> None:
    """Refuse prose with hand-written claims of effects (see `memmlp.report.claims`)."""
    for claim in claims(text):
        raise InputError(
            f"{name}, line {claim.line}: {claim.reason} in '{claim.sentence[:80]}'; allowed for effects are "
            "the placeholders of memmlp results docs"
        )


def _filled(name: str, text: str, words: Words) -> str:
    check_claims(name, text)
    environment = Environment(undefined=StrictUndefined, keep_trailing_newline=True, trim_blocks=True)
    environment.globals = words.functions()
    try:
        return f"{MARK}\n\n{environment.from_string(text).render()}"
    except TemplateError as error:
        raise InputError(f"{name}: {' '.join(str(error).split())}") from None
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def _table_page(source: KeptTable) -> str:
    return f"{MARK}\n\n{markdown(source.table)}\n{origin_words(source.kept)}\n"


def origin_words(kept: Kept) -> str:
    """Where the runs come from, and what makes them again."""
    parts = [f"{len(kept.every)} runs"]
    for attribute, what in ORIGIN.items():
        values = sorted({str(getattr(run.origin, attribute)) for run in kept.every} - {UNKNOWN})
        parts += [f"{what} {escaped(' and '.join(values))}"] if values else []
    recipes = _recipes(kept.every)
    parts += [f"recipes {recipes}"] if recipes else []
    return f"`{kept.command}`: {', '.join(parts)}."


def _recipes(runs: Iterable[Measured]) -> str:
    """The numbers of the components' recipes."""
    found = sorted({(name, number) for run in runs for name, number in run.origin.recipes.items()})
    return ", ".join(f"{escaped(name)} {number}" for name, number in found)


class Words:
    """What templates can say. Every method raises InputError, telling what is allowed, for a wrong name."""

    def __init__(self, sources: Mapping[str, KeptTable]):
        self.sources = sources

    def functions(self) -> dict[str, object]:
        """The placeholders by the name that templates call them by."""
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
            "way",
        )
        return {"names": sorted(self.sources), **{name: getattr(self, name) for name in names}}

    def has(self, name: str) -> bool:
        """Whether there are results of that name."""
        return name in self.sources

    def effect(self, name: str, arm: str, mode: str, metric: str) -> str:
        """A measured difference with its interval and verdict: `+1.17 [0.40, 2.23], open`."""
        cell = self._cell(name, arm, mode, metric)
        words = effect_words(cell, metric)
        number = " ".join(word.replace("*", "") for word in words[:2])
        return f"{number}, {self.verdict(name, arm, mode, metric)}"

    def verdict(self, name: str, arm: str, mode: str, metric: str) -> str:
        """The verdict on an arm's difference, in its word."""
        effect = self._cell(name, arm, mode, metric).effect
        return "not measured" if effect is None or effect.verdict is None else str(effect.verdict)

    def value(self, name: str, arm: str, mode: str, metric: str) -> str:
        """An arm's mean and standard deviation over seeds."""
        return value_words(self._cell(name, arm, mode, metric), metric)

    def paper(self, name: str, arm: str, metric: str) -> str:
        """The paper's difference."""
        printed = self._cell(name, arm, self._table(name).modes[0], metric).paper_effect
        return "not printed" if printed is None else f"{printed:+.2f}".replace("-", MINUS)

    def seen(self, name: str, mode: str, metric: str) -> str:
        """The difference that a table could have seen in every arm with 80 % power."""
        least = self._table(name).detectable(mode, metric)
        return "unknown" if least is None else f"{number_words(least)} {unit(metric)}".rstrip()

    def table(self, name: str) -> str:
        """The whole table."""
        return markdown(self._table(name)).rstrip()

    def title(self, name: str) -> str:
        """A table's title."""
        return escaped(caption(self._table(name)))

    def origin(self, name: str) -> str:
        """Where a table's runs come from, and what makes them again."""
        self._table(name)
        return origin_words(self.sources[name].kept)

    def summary(self, name: str, mode: str = "stream") -> str:
        """A line for each arm: the paper's differences, the measured ones and their verdicts."""
        table = self._table(name)
        metrics = table.measured_metrics
        lines = [
            f"| arm | compared with | {' | '.join(metrics)} |",
            f"| --- | --- |{' --- |' * len(metrics)}",
        ]
        for row in table.rows:
            if row.found and row.against:
                cells = [self._summed(name, row, mode, metric) for metric in metrics]
                lines.append(f"| {escaped(row.label)} | {escaped(row.against)} | {' | '.join(cells)} |")
        return "\n".join(lines)

    def way(self, name: str, mode: str = "stream") -> str:
        """How each step of a table's chain of arms changes each metric, and its share of the whole way.

        The chain leads from arm to control, from the table's control on; it is empty where that has none. A
        share is shown where the interval of the whole way leaves 0 out.
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

    def _summed(self, name: str, row: Row, mode: str, metric: str) -> str:
        printed = row.cells[mode][metric].paper_effect
        paper = "" if printed is None else f"; paper {self.paper(name, row.label, metric)}"
        return escaped(f"{self.effect(name, row.label, mode, metric)}{paper}")

    def _table(self, name: str) -> Table:
        _allowed("results", name, self.sources)
        return self.sources[name].table

    def _cell(self, name: str, arm: str, mode: str, metric: str) -> Cell:
        table = self._table(name)
        rows = {row.label: row for row in table.rows}
        _allowed(f"arm of {name}", arm, rows)
        _allowed("mode", mode, rows[arm].cells)
        _allowed(f"metric of {name}", metric, rows[arm].cells[mode])
        return rows[arm].cells[mode][metric]


def _chain(table: Table) -> list[Row]:
    """The arms from the one after the chain's first to the table's control, each the control of the next."""
    rows = {row.label: row for row in table.rows}
    found: list[Row] = []
    row = rows[table.control]
    while row.against in rows and row.against != table.control:
        found.insert(0, row)
        row = rows[row.against]
    return found


def _share(cell: Cell, way: Cell, metric: str) -> str:
    """A step's difference, its share of the way to the control, and its verdict."""
    if cell.effect is None:
        return MISSING
    words = [effect_words(cell, metric)[0].replace("*", "")]
    if way.effect is not None and (way.effect.low or 0) * (way.effect.high or 0) > 0:
        words.append(f"{round(100 * cell.effect.mean / -way.effect.mean)} %".replace("-", MINUS))
    return ", ".join([*words, str(cell.effect.verdict or "no verdict")])


def _whole(cell: Cell) -> str:
    """The way from an arm to its control: the difference turned round, its verdict, and the paper's."""
    if cell.effect is None:
        return MISSING
    verdict = TURNED.get(cell.effect.verdict, cell.effect.verdict) if cell.effect.verdict else "no verdict"
    printed = "" if cell.paper_effect is None else f"; paper {-cell.paper_effect:+.2f}"
    return f"{-cell.effect.mean:+.2f}, {verdict}{printed}".replace("-", MINUS)


def _allowed(what: str, name: str, known: Iterable[str]) -> None:
    if name not in known:
        raise InputError(f"'{name}' is no {what}; allowed are {', '.join(known) or 'none'}")
