"""Formats a table as Markdown, LaTeX, JSON or text for a terminal."""

import itertools
import json
import math
import textwrap
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace

from rich.console import Console

from memmlp.common.files import make_json_safe
from memmlp.common.text_formats import escape_latex, escape_markdown
from memmlp.evaluation.metric_facts import HIGHER, UNITS
from memmlp.report.tables.flags import join_quoted
from memmlp.report.tables.statistics import FEW_GROUPS, Verdict
from memmlp.report.tables.table import MAX_TIME_RATIO, Cell, Effect, Row, Table
from memmlp.sweep.definition import COSTS

COST_UNITS = {"FLOPs": "G", "MACs": "G", "parameters": "M", "size": "MB"}
MISSING = "-"
MINUS = "\N{MINUS SIGN}"
CONFOUNDED = "‡"  # mark of a row that differs from its control in more than its label names
ARROWS = {"lower": "↓", "higher": "↑"}
COLUMN_GAP = "  "  # text between columns on a terminal
MAX_LABEL_WIDTH = 18  # maximum width of the variant column on a terminal, characters

Line = tuple[tuple[str, ...], ...]
"""A line of cells: variant, seeds, and one cell for each metric. A cell has one to five parts."""


@dataclass(frozen=True)
class Grid:
    """The lines of an evaluation mode, grouped by variant; `mode` is None if modes do not matter."""

    mode: str | None
    header: tuple[str, ...]
    groups: tuple[tuple[Line, ...], ...]

    @property
    def lines(self) -> list[list[str]]:
        """All lines, with the parts of each cell joined."""
        return [[" ".join(cell) for cell in line] for group in self.groups for line in group]


def make_grids(table: Table) -> list[Grid]:
    """Return a grid for each mode.

    If the table has only costs or no results, there is a single grid without a mode.
    """
    timeless = set(table.metrics) <= set(COSTS) or not any(row.found for row in table.rows)
    header = ("variant", "seeds", *map(make_heading, table.metrics))
    found = []
    for mode in table.modes[:1] if timeless else table.modes:
        groups = tuple(tuple(_make_lines(table, row, mode)) for row in table.rows)
        found.append(Grid(None if timeless else mode, header, groups))
    return found


def make_heading(metric: str) -> str:
    """Return a metric's name with its unit and an arrow for the better direction."""
    return f"{add_unit(metric)} {ARROWS.get(find_direction(metric), '')}".rstrip()


def add_unit(metric: str) -> str:
    """Return a metric's name with its unit, if any, in brackets."""
    return f"{metric} [{find_unit(metric)}]" if find_unit(metric) else metric


def find_direction(metric: str) -> str:
    """Return "lower" or "higher", the better direction of a metric; empty for an unknown custom metric.

    A custom metric is unknown if its package is not in use.
    """
    if metric not in UNITS and metric not in COSTS:
        return ""
    return "higher" if metric == "FPS" or metric in HIGHER else "lower"


def find_unit(metric: str) -> str:
    """Return a metric's unit; empty for a metric without a unit."""
    return UNITS.get(metric, COST_UNITS.get(metric, "")).replace("10^2", "10²").replace("s^3", "s³")


def make_caption(table: Table) -> str:
    """Return the table's title, with the paper's table number if any."""
    return f"Table {table.number}: {table.title}" if table.number else table.title


def make_legend(table: Table) -> list[str]:
    """Return the lines that explain branches, measured values, verdicts and statistical power."""
    source = f" ({table.branch_source})" if table.branch_source else ""
    lines = [f"{describe_branches(table)}{source}"] if table.measured_metrics else []
    if not any(row.found for row in table.rows):
        return lines
    if table.measured_metrics:
        groups = max(row.groups for row in table.rows)
        interval = "" if table.number else f" [95 % interval over seeds and at most {groups} groups of clips]"
        lines.append(f"mean ± sd over seeds of the means over test clips{interval}")
    if any(any(table.list_effects(mode)) for mode in table.modes):
        lines += [_explain_differences(table), _explain_verdicts(table)]
        if table.analyses:
            parts = [f"{seeds} ({100 * level:.2g} %)" for seeds, level in sorted(set(table.analyses))]
            lines.append(
                f"seeds were added where verdicts were inconclusive, with interim analyses at "
                f"{', '.join(parts)} seeds, which share the 5 %; (3): decided at 3 seeds, and final; means "
                "and intervals use all seeds"
            )
        lines += _explain_branches(table)
        lines += [f"{mode} mode: {text}" for mode in table.modes if (text := describe_power(table, mode))]
    if explain_marks(table):
        lines.append(_summarize_agreement(table))
    return lines


def describe_branches(table: Table) -> str:
    """Describe the branches of the rows: the most frequent one, and the variants with others."""
    labels: dict[str, list[str]] = {}
    for row in table.rows:
        if not row.is_paper_only:
            labels.setdefault(row.branch, []).append(row.label)
    most, *others = sorted(labels, key=lambda branch: -len(labels[branch]))
    texts = "; ".join(f"{branch} for {join_quoted(labels[branch])}" for branch in others)
    return f"errors of the branch: {most}{f' ({texts})' if texts else ''}"


def _explain_differences(table: Table) -> str:
    own = [
        row.pairing or f"'{row.label}' from '{row.against}'"
        for row in table.rows
        if row.pairing or row.against not in (None, table.control)
    ]
    others = "".join(f", of {text}" for text in dict.fromkeys(own))
    least = "the analysis' level" if table.analyses else "0.05"
    star = f"; * p < {least} by Holm's correction over the table's {table.comparisons} comparisons"
    return (
        f"diff.: from '{table.control}'{others} [95 % interval, paired by seed and test clip]"
        f"{star if table.comparisons else ''}"
    )


def _explain_verdicts(table: Table) -> str:
    margins = [
        f"{metric} {format_number(table.smallest[metric])} {find_unit(metric)}"
        for metric in table.measured_metrics
        if metric in table.smallest
    ]
    return (
        "verdicts: holds (significant, with the paper's sign), opposite (significant, with the other sign), "
        "higher or lower (significant, where the paper prints no difference), equivalent (nearer to 0 than "
        f"the smallest effect of interest: {', '.join(margins)}), inconclusive (none of these)"
    )


def _explain_branches(table: Table) -> list[str]:
    lines = [
        f"{CONFOUNDED} confounded, so counted apart: '{row.label}': {row.confounded}"
        for row in table.rows
        if row.confounded
    ]
    if shown := dict.fromkeys(branch for row in table.rows for branch in row.branches):
        lines.append(
            f"{', '.join(shown)}: differences with variant and control in this branch, verdicts corrected "
            "over the branch's comparisons; holds and opposite refer to the paper's difference above"
        )
    for branch in dict.fromkeys(branch for row in table.rows for branch in row.unrecorded):
        rows = [row.label for row in table.rows if branch in row.unrecorded]
        every = len(rows) == sum(row.against is not None for row in table.rows)
        lines.append(f"{branch} not recorded: {'every comparison' if every else join_quoted(rows)}")
    return lines


def describe_power(table: Table, mode: str) -> str:
    """Describe the differences that every variant detects with 80 % power; empty if these are unknown.

    A difference larger than all values of its metric says only that there are too few seeds.
    """
    found, lost, blind = [], [], dict[str, None]()
    for metric in table.measured_metrics:
        if (least := table.find_detectable(mode, metric)) is None:
            continue
        means = [cell.mean for _, name, cell, _ in table.list_effects(mode) if name == metric]
        finite = [mean for mean in means if mean is not None and math.isfinite(mean)]
        if least <= max(finite, default=0.0):
            found.append(f"{metric} {format_number(least)} {find_unit(metric)}".rstrip())
            blind |= dict.fromkeys(table.list_blind_variants(mode, metric))
        else:
            lost.append(metric)
    but = f" except {', '.join(map(repr, blind))}" if blind else ""
    texts = []
    if found:
        texts.append(f"with 80 % power every comparison{but} detects a difference of {', '.join(found)}")
    if lost:
        texts.append(
            f"in {', '.join(lost)} at least one comparison would miss even a difference as large as the error"
        )
    return "; ".join(texts)


def _summarize_agreement(table: Table) -> str:
    mode = table.modes[0]
    found, apart = table.count_verdicts(mode), table.count_verdicts(mode, confounded=True)
    summary = f"; of {found.total()} effects in {mode} mode: {format_counts(found)}" if found else ""
    summary += f"; {apart.total()} confounded, counted apart: {format_counts(apart)}" if apart else ""
    return f"paper: value (difference; {explain_marks(table)}){summary}"


def explain_marks(table: Table) -> str:
    """Explain ✓ and ✗ beside the paper's differences; empty without them."""
    cells = [cell for row in table.rows for cells in row.cells.values() for cell in cells.values()]
    if all(cell.agrees is None for cell in cells):
        return ""
    signs = "; of a cost by its sign" if set(table.metrics) & set(COSTS) else ""
    if any(cell.paper_effect and cell.effect and cell.effect.within_noise for cell in cells):
        signs += f", of a time from x {MAX_TIME_RATIO:g} on"
    return f"✓ it holds here, ✗ the opposite does{signs}"


def format_counts(counts: Counter[Verdict]) -> str:
    """Return the numbers of verdicts: `8 holds, 4 inconclusive`."""
    return ", ".join(f"{counts[verdict]} {verdict}" for verdict in Verdict if counts[verdict])


def _make_lines(table: Table, row: Row, mode: str) -> Iterator[Line]:
    """Yield a variant's lines: measured values, differences from the control, and the paper's values."""
    cells = [(row.cells[mode][metric], metric) for metric in table.metrics]
    paper = tuple((format_paper_value(cell, metric),) for cell, metric in cells)
    if row.is_paper_only:
        yield ((row.label,), ("paper",), *paper)
        return
    values = ((format_value(cell, metric), *_format_interval(table, cell)) for cell, metric in cells)
    label = f"{row.label} {CONFOUNDED}" if row.confounded else row.label
    yield ((label,), (f"{len(row.found)}/{len(row.wanted)}",), *values)
    if any(cell.effect for cell, _ in cells):
        yield (("",), ("diff.",), *(format_effect(cell, metric) for cell, metric in cells))
    for branch, by_mode in row.branches.items():
        others = ((by_mode[mode].get(metric), cell) for cell, metric in cells)
        yield (("",), (branch,), *(format_branch_effect(effect, cell) for effect, cell in others))
    if any(cell.paper is not None for cell, _ in cells):
        yield (("",), ("paper",), *paper)


def _format_interval(table: Table, cell: Cell) -> tuple[str, ...]:
    """Return the interval of a mean, for tables of this project; the paper's tables are about differences."""
    if table.number or cell.low is None or cell.high is None:
        return ()
    digits = count_interval_decimals(cell.high - cell.low)
    return (f"[{format_signed(cell.low, f'.{digits}f')}, {format_signed(cell.high, f'.{digits}f')}]",)


def format_value(cell: Cell, metric: str) -> str:
    """Return mean ± standard deviation over seeds; only the mean for costs, except for the column `ms`."""
    if cell.mean is None or cell.sd is None or (metric in COSTS and metric != "ms"):
        return format_mean(cell, metric)
    digits = count_decimals(cell.mean)
    missing = describe_missing_clips(cell.counted, cell.clips)
    return f"{cell.mean:.{digits}f} ± {cell.sd:.{digits}f}{missing}"


def format_mean(cell: Cell, metric: str) -> str:
    """Return the mean over seeds, with the number of clips if some have no value."""
    if cell.mean is None:
        return MISSING
    if metric in COSTS:
        return format_significant(cell.mean, 3)
    return f"{cell.mean:.{count_decimals(cell.mean)}f}{describe_missing_clips(cell.counted, cell.clips)}"


def describe_missing_clips(counted: int, clips: int) -> str:
    """Return ` (9 of 12 clips)` if a mean is over a part of the clips, otherwise an empty text."""
    return f" ({counted} of {clips} clips)" if counted < clips else ""


def format_effect(cell: Cell, metric: str) -> tuple[str, ...]:
    """Return the parts of a cell: difference, interval, verdict, p-values; for a cost, difference and ratio.

    A significant difference has a star. The ratio is that of a variant's cost to the control's cost.
    """
    effect = cell.effect
    if effect is None:
        return (MISSING,)
    if metric in COSTS:
        difference = format_significant(effect.mean, 3, "+").replace("-", MINUS) if effect.mean else "0"
        return difference, *_format_ratio(cell.mean, effect.mean)
    least = 2 if cell.mean is None else count_decimals(cell.mean)
    if effect.low is None or effect.high is None:
        return (format_signed(effect.mean, f"+.{least}f"),)
    digits = count_interval_decimals(effect.high - effect.low, least)
    if effect.is_significant and effect.mean:  # show at least one digit that is not zero
        digits = max(digits, -math.floor(math.log10(abs(effect.mean))))
    low, high = (format_signed(number, f".{digits}f") for number in (effect.low, effect.high))
    star = "*" if effect.is_significant else ""
    at = f" ({effect.decided})" if effect.decided else ""
    parts = [f"{format_signed(effect.mean, f'+.{digits}f')}{star}", f"[{low}, {high}]"]
    if effect.verdict is not None:
        parts.append(f"{effect.verdict}{at}")
    if effect.holm is not None and 0 < effect.groups <= FEW_GROUPS:
        parts.append(f"p {format_number(effect.holm)}")
    if effect.bootstrap is not None:
        parts.append(f"bootstrap {format_number(effect.bootstrap)}")
    return tuple(parts)


def format_branch_effect(effect: Effect | None, cell: Cell) -> tuple[str, ...]:
    """Return difference and verdict in another branch than the row's, for the row's cell."""
    if effect is None:
        return (MISSING,)
    number, *_ = format_effect(replace(cell, effect=effect), "")
    return (number,) if effect.verdict is None else (number, str(effect.verdict))


def format_number(value: float) -> str:
    """Return a number with two significant digits."""
    return format_significant(value, 2)


def format_significant(value: float, digits: int, sign: str = "") -> str:
    """Return a number with `digits` significant digits; large numbers are whole, without an exponent."""
    words = f"{value:{sign}.{digits}g}"
    return f"{value:{sign}.0f}" if "e+" in words else words


def _format_ratio(value: float | None, difference: float) -> tuple[str, ...]:
    if value is None or value == difference:
        return ()
    return (f"(x {format_significant(value / (value - difference), 3)})",)


def format_signed(number: float, form: str) -> str:
    """Format a number with a typographic minus; zero gives "0"."""
    return format(number, form).replace("-", MINUS) if number else "0"


def count_decimals(value: float) -> int:
    """Return the number of decimals of an error: 2, or enough for two significant digits below 0.1."""
    return max(1 - math.floor(math.log10(abs(value))), 2) if value and math.isfinite(value) else 2


def count_interval_decimals(width: float, least: int = 2) -> int:
    """Return `least` or `least` + 1 decimals, to show two significant digits of an interval's half width."""
    return min(max(1 - math.floor(math.log10(width / 2)), least), least + 1) if width > 0 else least


def format_paper_value(cell: Cell, metric: str) -> str:
    """Return the paper's value, its difference from the control, and ✓ or ✗ if measured results decide."""
    if cell.paper is None:
        return MISSING
    digits = 1 if metric in ("ms", "network ms", "pose ms", "FPS") else 2
    value = f"{cell.paper:.{digits}f}"
    if cell.paper_effect is None:
        return value
    mark = {None: "", True: " ✓", False: " ✗"}[cell.agrees]
    ratio = _format_ratio(cell.paper, cell.paper_effect) if metric in COSTS else ()
    return " ".join([f"{value} ({format_signed(cell.paper_effect, f'+.{digits}f')}{mark})", *ratio])


def to_markdown(table: Table) -> str:
    """Return the table in GitHub's Markdown."""
    parts = [f"### {escape_markdown(make_caption(table))}"]
    for grid in make_grids(table):
        rows = [list(map(escape_markdown, grid.header)), ["---", ":---:", *["---:"] * len(table.metrics)]]
        rows += [list(map(escape_markdown, line)) for line in grid.lines]
        text = "\n".join(f"| {' | '.join(row)} |" for row in rows)
        parts.append(f"**{grid.mode}**\n\n{text}" if grid.mode else text)
    remarks = "\n".join(f"- {escape_markdown(line)}" for line in list_remarks(table))
    return "\n\n".join([*parts, remarks] if remarks else parts) + "\n"


def to_latex(table: Table) -> str:
    """Return a LaTeX table for the packages booktabs and amssymb."""
    lines = ["% needs \\usepackage{booktabs,amssymb}", r"\begin{table}", r"\centering", r"\small"]
    lines.append(rf"\caption{{{escape_latex(make_caption(table))}}}")
    lines.append(rf"\begin{{tabular}}{{ll{'r' * len(table.metrics)}}}")
    lines.append(r"\toprule")
    for number, grid in enumerate(make_grids(table)):
        columns = len(grid.header)
        lines += [r"\midrule"] if number else []
        lines += [rf"\multicolumn{{{columns}}}{{l}}{{\emph{{{grid.mode} mode}}}} \\"] if grid.mode else []
        lines += [" & ".join(map(escape_latex, grid.header)) + r" \\", r"\midrule"]
        lines += [" & ".join(map(escape_latex, line)) + r" \\" for line in grid.lines]
    lines += [r"\bottomrule", r"\end{tabular}"]
    remarks = map(escape_latex, list_remarks(table))
    lines += [rf"\par\smallskip\raggedright\footnotesize {remark}." for remark in remarks]
    return "\n".join([*lines, r"\end{table}"]) + "\n"


def to_json(table: Table) -> str:
    """Return the table's content as JSON, including the values of each seed."""
    fields = asdict(table)
    for row, row_fields in zip(table.rows, fields["rows"], strict=True):
        for mode, cells in row.cells.items():
            for metric, cell in cells.items():
                summary = {"mean": cell.mean, "sd": cell.sd, "agrees": cell.agrees}
                row_fields["cells"][mode][metric] |= summary
    return json.dumps(make_json_safe(fields), indent=2, ensure_ascii=False) + "\n"


def print_table(table: Table, console: Console) -> None:
    """Print the table on a terminal; columns that do not fit go into additional blocks below."""
    console.print(make_caption(table), style="bold", soft_wrap=True)
    for grid in make_grids(table):
        if grid.mode:
            console.print(f"{grid.mode} mode", style="italic")
        for columns in _divide_columns(grid, console.width):
            console.out("\n".join(_format_lines(grid, columns)), "", sep="\n", highlight=False)
    for line in list_remarks(table):
        console.print(f"- {line}")
    console.print()


FORMATS: dict[str, Callable[[Table], str]] = {"md": to_markdown, "tex": to_latex, "json": to_json}


def list_remarks(table: Table) -> list[str]:
    """Return all lines below a table: explanations, flags and notes."""
    return [*make_legend(table), *table.flags, *table.notes]


def _divide_columns(grid: Grid, width: int) -> list[list[int]]:
    """Divide the metric columns into groups of similar size that fit the width.

    The first two columns (variant, seeds) precede each group.
    """
    columns = range(2, len(grid.header))
    widths = [_find_width(column) + len(COLUMN_GAP) for column in zip(*_make_blocks(grid), strict=True)]
    for groups in range(1, len(columns) + 1):
        size = -(-len(columns) // groups)
        fits = [list(columns[i : i + size]) for i in range(0, len(columns), size)]
        if all(sum(widths[:2]) + sum(widths[i] for i in group) <= width for group in fits):
            break
    return fits


def _format_lines(grid: Grid, columns: Sequence[int]) -> Iterator[str]:
    """Yield a grid's columns as lines of text. Rich's tables are too slow for hundreds of variants."""
    blocks = [[block[i] for i in (0, 1, *columns)] for block in _make_blocks(grid)]
    widths = [_find_width(block[i] for block in blocks) for i in range(len(columns) + 2)]
    for number, block in enumerate(blocks):
        for words in itertools.zip_longest(*block, fillvalue=""):
            cells = (f"{word:{'<' if i < 2 else '>'}{widths[i]}}" for i, word in enumerate(words))
            yield COLUMN_GAP.join(cells).rstrip()
        if number == 0:
            yield "─" * (sum(widths) + len(COLUMN_GAP) * (len(widths) - 1))
        elif len(block[1]) > 1:
            yield ""


def _find_width(parts: Iterable[Sequence[str]]) -> int:
    return max(len(word) for part in parts for word in part)


def _make_blocks(grid: Grid) -> list[list[Sequence[str]]]:
    return [list(map(_split_header, grid.header)), *map(_make_block, grid.groups)]


def _make_block(group: Sequence[Line]) -> list[Sequence[str]]:
    columns: list[list[str]] = [[] for _ in group[0][1:]]
    for _, *cells in group:
        height = max(map(len, cells))
        for column, parts in zip(columns, cells, strict=True):
            column += [*parts, *[""] * (height - len(parts))]
    return [textwrap.wrap(group[0][0][0], MAX_LABEL_WIDTH), *columns]


def _split_header(name: str) -> list[str]:
    metric, _, rest = name.partition(" [")
    unit, _, arrow = rest.partition("] ")
    return [f"{metric} {arrow}", unit] if rest else [name]
