"""Result pages: one for each table, and pages from templates with numbers from the tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

from memmlp.common.errors import InputError, import_optional
from memmlp.common.text_formats import escape_markdown
from memmlp.report.kept_results import KeptResults
from memmlp.report.pictures.frontier import COST_HEADINGS, draw_frontiers, has_frontier
from memmlp.report.tables.measured_run import UNKNOWN
from memmlp.report.tables.statistics import Verdict
from memmlp.report.tables.table import Cell, Row, Table
from memmlp.report.tables.table_text import (
    CONFOUNDED,
    MINUS,
    MISSING,
    add_unit,
    count_decimals,
    find_unit,
    format_branch_effect,
    format_counts,
    format_effect,
    format_number,
    format_significant,
    format_value,
    make_caption,
    to_markdown,
)

MARK = "<!-- made by: memmlp results docs -->"
ORIGIN = {
    "code": "commit", "torch": "torch", "hardware": "processor", "device": "device", "gpu": "GPU",
    "threads": "threads", "precision": "precision", "data": "data", "body": "body",
}  # fmt: skip
REVERSED_VERDICTS = {Verdict.HIGHER: Verdict.LOWER, Verdict.LOWER: Verdict.HIGHER}


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


def make_pages(sources: Mapping[str, KeptTable], templates: Mapping[str, str]) -> dict[str, str]:
    """Return the texts of all pages by file name.

    Args:
        sources: the tables by page name, without the suffix.
        templates: the templates' texts by file name.

    Raises:
        InputError: if a template and a table have the same page name, or a placeholder has an unknown name.
    """
    pages = {}
    for name, source in sorted(sources.items()):
        tables = "\n".join(map(to_markdown, (source.table, *source.by_source)))
        frontier = _describe_frontier(name, source.table) if has_frontier(source.table) else ""
        pages[f"{name}.md"] = f"{MARK}\n\n{tables}\n{frontier}{describe_origin(source.kept)}\n"
    for name in sorted(pages.keys() & templates.keys()):
        raise InputError(f"{name}: a template and a table's page have the same name; rename one of them")
    placeholders = Placeholders(sources).collect_functions()
    return pages | {
        name: _fill_template(name, text, placeholders) for name, text in sorted(templates.items())
    }


def draw_pictures(sources: Mapping[str, KeptTable]) -> dict[str, bytes]:
    """Return the pictures of all pages by file name: frontiers, where the training compute differs."""
    tables = {name: source.table for name, source in sources.items() if has_frontier(source.table)}
    return {f"{name}_frontier.svg": draw_frontiers(table) for name, table in tables.items()}


def _describe_frontier(name: str, table: Table) -> str:
    """Return the picture of error against compute and latency, and a table of costs."""
    rows = [
        [
            row.label,
            *(format_significant(row.costs[c], 3) if c in row.costs else MISSING for c in COST_HEADINGS),
        ]
        for row in table.rows
        if row.found
    ]
    costs = _make_markdown_table(["variant", *COST_HEADINGS.values()], rows)
    text = "Error against training compute and live latency, with 95 % intervals over seeds and clip groups:"
    return f"{text}\n\n![Error against compute and latency]({name}_frontier.svg)\n\n{costs}\n\n"


def _fill_template(name: str, text: str, placeholders: Mapping[str, object]) -> str:
    """Render a template. Raises InputError, which names the template."""
    jinja2 = import_optional("jinja2", "plots", name)
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, keep_trailing_newline=True, trim_blocks=True
    )
    environment.globals = dict(placeholders)
    try:
        return f"{MARK}\n\n{environment.from_string(text).render()}"
    except (jinja2.TemplateError, InputError) as error:
        raise InputError(f"{name}: {' '.join(str(error).split())}") from None


def describe_origin(kept: KeptResults) -> str:
    """Describe the command, the code and the machines that made kept runs."""
    counts = {"run": kept.run_count - kept.untrained_count, "untrained network": kept.untrained_count}
    parts = [" and ".join(f"{count} {what}{'s' * (count != 1)}" for what, count in counts.items() if count)]
    for attribute, what in ORIGIN.items():
        # A run has several values if several machines worked on it or on its prerequisites.
        values = {one for run in kept.all_runs for one in str(getattr(run.origin, attribute)).split(", ")}
        *others, last = sorted(values - {UNKNOWN}) or [""]
        if last:
            parts.append(f"{what} {escape_markdown(' and '.join(filter(None, [', '.join(others), last])))}")
    parts += sorted({escape_markdown(run.origin.partial) for run in kept.all_runs if run.origin.partial})
    versions = sorted({item for run in kept.all_runs for item in run.origin.every_version.items()})
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
    """The functions that templates can call. An unknown name raises InputError with the valid names."""

    def __init__(self, sources: Mapping[str, KeptTable]):
        self.sources = sources

    def collect_functions(self) -> dict[str, object]:
        """Return the functions by name, and the list `names` of all results."""
        methods = {name: getattr(self, name) for name in dir(self) if not name.startswith("_")}
        return {**methods, "names": sorted(self.sources)}

    def has(self, name: str) -> bool:
        """Return whether there are results with that name."""
        return name in self.sources

    def title(self, name: str) -> str:
        """Return a table's title."""
        return escape_markdown(make_caption(self._find_table(name)))

    def origin(self, name: str) -> str:
        """Describe the command, the code and the machines that made a table's runs."""
        self._find_table(name)
        return describe_origin(self.sources[name].kept)

    def effect(self, name: str, variant: str, mode: str, metric: str) -> str:
        """Return a measured difference with its interval and verdict: `+1.17 [0.40, 2.23], holds`."""
        words = format_effect(self._find_cell(name, variant, mode, metric), metric)
        number = " ".join(word.replace("*", "") for word in words[:2])
        return f"{number}, {self.verdict(name, variant, mode, metric)}"

    def verdict(self, name: str, variant: str, mode: str, metric: str) -> str:
        """Return the verdict on a variant's difference, such as `holds`."""
        effect = self._find_cell(name, variant, mode, metric).effect
        return "not measured" if effect is None or effect.verdict is None else str(effect.verdict)

    def value(self, name: str, variant: str, mode: str, metric: str) -> str:
        """Return a variant's mean and standard deviation over seeds."""
        return format_value(self._find_cell(name, variant, mode, metric), metric)

    def detectable(self, name: str, mode: str, metric: str, variant: str) -> str:
        """Return the smallest difference of a variant that is detectable with 80 % power."""
        effect = self._find_cell(name, variant, mode, metric).effect
        least = effect.detectable if effect else None
        return "unknown" if least is None else f"{format_number(least)} {find_unit(metric)}".rstrip()

    def summary(self, name: str, mode: str = "stream") -> str:
        """Return a table with a row for each variant: measured difference, verdict, and printed difference.

        If the table has only costs, the rows show measured costs and the paper's costs.
        """
        table, shown = self._find_table(name), [row for row in self._find_table(name).rows if row.found]
        if metrics := table.measured_metrics:
            rows = [
                [
                    _mark(row),
                    row.against,
                    *(self._compare_with_paper(name, row, mode, metric) for metric in metrics),
                ]
                for row in shown
                if row.against
            ]
            return f"In {mode} mode:\n\n{_make_markdown_table(['variant', 'compared with', *metrics], rows)}"
        costs = [row.cells[table.modes[0]] for row in shown]
        rows = [
            [row.label, *(_describe_cost(cells[metric], metric) for metric in table.metrics)]
            for row, cells in zip(shown, costs, strict=True)
        ]
        return _make_markdown_table(["variant", *map(add_unit, table.metrics)], rows)

    def _compare_with_paper(self, name: str, row: Row, mode: str, metric: str) -> str:
        printed = row.cells[mode][metric].paper_effect
        paper = "" if printed is None else f"; paper {printed:+.2f}".replace("-", MINUS)
        return f"{self.effect(name, row.label, mode, metric)}{_list_branches(row, mode, metric)}{paper}"

    def held(self, names: Sequence[str], mode: str = "stream") -> str:
        """Count verdicts on the paper's effects, and list them in a table with a row for each variant.

        Only effects with a sign in the paper count; `-` stands for the others. Confounded rows count apart.
        Verdicts in other branches than the printed one stand in parentheses.

        Args:
            names: the names of the tables' results.
            mode: the mode of evaluation.
        """
        metrics = list(dict.fromkeys(m for name in names for m in self._find_table(name).measured_metrics))
        rows, counts = [], (Counter[Verdict](), Counter[Verdict]())
        for name in names:
            table = self._find_table(name)
            for confounded, found in enumerate(counts):
                found.update(table.count_verdicts(mode, bool(confounded)))
            for row in (row for row in table.rows if row.found and row.against):
                cells = [
                    self.verdict(name, row.label, mode, metric) + _list_branches(row, mode, metric)
                    if metric in table.measured_metrics and row.cells[mode][metric].paper_effect
                    else MISSING
                    for metric in metrics
                ]
                if set(cells) != {MISSING}:
                    link = f"[{table.number or name}]({name}.md)"
                    rows.append([link, _mark(row), row.against or "", *cells])
        sound, apart = counts
        total = (
            f"Of {sound.total()} effects with a sign in the paper, in {mode} mode: {format_counts(sound)}."
        )
        if apart:
            total += (
                f" {apart.total()} confounded effects ({CONFOUNDED}) count apart: {format_counts(apart)}."
            )
        return f"{total}\n\n{_make_markdown_table(['table', 'variant', 'compared with', *metrics], rows)}"

    def steps(self, name: str, mode: str = "stream") -> str:
        """Return a table of the differences between neighbours in a chain of variants, with percentages.

        In a chain, each variant is the control of the next, and the table's control is the last variant.
        Without a chain, the text is empty. Percentages refer to the difference between both ends of the
        chain; they are shown if the interval of this difference excludes 0.
        """
        table = self._find_table(name)
        by_label = {row.label: row for row in table.rows}
        chain = [by_label[table.control]]
        while (against := chain[0].against) in by_label and against != table.control:
            chain.insert(0, by_label[against])
        if len(chain) < 2:
            return ""
        first, *steps = chain
        metrics = table.measured_metrics
        rows = [
            [
                row.label,
                *(_describe_step(row.cells[mode][one], first.cells[mode][one], one) for one in metrics),
            ]
            for row in steps
        ]
        total = f"total, from {first.label}"
        rows.append([total, *(_describe_reverse(first.cells[mode][metric]) for metric in metrics)])
        return _make_markdown_table(["step", *metrics], rows)

    def decided(self, name: str, *patterns: str) -> str:
        """Return how many of a table's differences are significant: `53 of 148`; confounded rows count apart.

        Args:
            name: the name of the table's results.
            patterns: regular expressions; clips with equal matches of a pattern become one group.
        """
        table, regroup = self._find_table(name), self.sources[name].regroup
        if patterns:
            if regroup is None:
                raise InputError(f"{name}: decided must have no patterns; these clips cannot be regrouped")
            table = regroup(patterns)
        counts = (Counter[bool](), Counter[bool]())
        undecided = (Verdict.INCONCLUSIVE, Verdict.EQUIVALENT)
        for row, *_, effect in (one for mode in table.modes for one in table.list_effects(mode)):
            counts[bool(row.confounded)][effect.verdict not in undecided] += 1
        sound, apart = (f"{found[True]} of {found.total()}" for found in counts)
        return f"{sound}, and {apart} confounded" if counts[1] else sound

    def _find_table(self, name: str) -> Table:
        _check_name("results", name, self.sources)
        return self.sources[name].table

    def _find_cell(self, name: str, variant: str, mode: str, metric: str) -> Cell:
        rows = {row.label: row for row in self._find_table(name).rows}
        _check_name(f"variant of {name}", variant, rows)
        _check_name("mode", mode, rows[variant].cells)
        _check_name(f"metric of {name}", metric, rows[variant].cells[mode])
        return rows[variant].cells[mode][metric]


def _mark(row: Row) -> str:
    return f"{row.label} {CONFOUNDED}" if row.confounded else row.label


def _list_branches(row: Row, mode: str, metric: str) -> str:
    """Return the differences and verdicts in other branches: ` (rotation +0.69 opposite)`."""
    effects = {branch: by_mode[mode].get(metric) for branch, by_mode in row.branches.items()}
    cell = row.cells[mode][metric]
    words = [
        f"{branch} {' '.join(format_branch_effect(effect, cell)).replace('*', '')}"
        for branch, effect in effects.items()
        if effect
    ]
    words += [f"{branch} not recorded" for branch in row.unrecorded]
    return f" ({', '.join(words)})" if words else ""


def _make_markdown_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; all cells except links are escaped."""
    cells = [
        [cell if cell and cell.endswith(".md)") else escape_markdown(cell or "") for cell in row]
        for row in rows
    ]
    lines = [list(map(escape_markdown, heads)), ["---"] * len(heads), *cells]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _describe_cost(cell: Cell, metric: str) -> str:
    return format_value(cell, metric) + ("" if cell.paper is None else f"; paper {cell.paper:.2f}")


def _describe_step(step: Cell, total: Cell, metric: str) -> str:
    """Return a step's difference, its percentage of the chain's total difference, and its verdict."""
    if step.effect is None:
        return MISSING
    words = [format_effect(step, metric)[0].replace("*", "")]
    if total.effect is not None and (total.effect.low or 0) * (total.effect.high or 0) > 0:
        words.append(f"{round(100 * step.effect.mean / -total.effect.mean)} %".replace("-", MINUS))
    return ", ".join([*words, str(step.effect.verdict or "no verdict")])


def _describe_reverse(cell: Cell) -> str:
    """Return the difference from a variant to its control, with the reversed verdict."""
    if cell.effect is None:
        return MISSING
    verdict = (
        REVERSED_VERDICTS.get(cell.effect.verdict, cell.effect.verdict)
        if cell.effect.verdict
        else "no verdict"
    )
    printed = "" if cell.paper_effect is None else f"; paper {-cell.paper_effect:+.2f}"
    digits = 2 if cell.mean is None else count_decimals(cell.mean)
    return f"{-cell.effect.mean:+.{digits}f}, {verdict}{printed}".replace("-", MINUS)


def _check_name(kind: str, name: str, choices: Iterable[str]) -> None:
    if name not in choices:
        raise InputError(f"'{name}': {kind} must be one of {', '.join(choices) or 'none'}")
