"""A table's output formats: Markdown, LaTeX, JSON, or lines on a terminal."""

from __future__ import annotations

import itertools
import json
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict

from rich.console import Console

from memmlp.common.files import plain
from memmlp.report.tables.table import Table
from memmlp.report.tables.table_text import MINUS, Grid, VariantLine, caption, grids, legend

GAP = "  "  # stands between columns on a terminal
LABEL = 18  # the largest width of the variants' column on a terminal, characters
TEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{",
    "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$", MINUS: "$-$",
    "↓": r"$\downarrow$", "↑": r"$\uparrow$", "✓": r"$\checkmark$", "✗": r"$\times$",
    "²": r"\textsuperscript{2}", "³": r"\textsuperscript{3}", "<": r"$<$", ">": r"$>$",
}  # fmt: skip


def markdown(table: Table) -> str:
    """Return the table in GitHub's Markdown."""
    parts = [f"### {escaped(caption(table))}"]
    for grid in grids(table):
        rows = [list(map(escaped, grid.header)), ["---", ":---:", *["---:"] * len(table.metrics)]]
        rows += [[escaped(word) for word in (*line.head, *map(" ".join, line.cells))] for line in _all(grid)]
        text = "\n".join(f"| {' | '.join(row)} |" for row in rows)
        parts.append(f"**{grid.mode}**\n\n{text}" if grid.mode else text)
    remarks = "\n".join(f"- {escaped(line)}" for line in _remarks(table))
    return "\n\n".join([*parts, remarks] if remarks else parts) + "\n"


def escaped(text: str) -> str:
    """Return the text with all characters escaped that Markdown would interpret."""
    return re.sub(r"([\\`*_|<>\[\]#])", r"\\\1", text)


def latex(table: Table) -> str:
    """Return a LaTeX table for the packages booktabs and amssymb."""
    lines = ["% needs \\usepackage{booktabs,amssymb}", r"\begin{table}", r"\centering", r"\small"]
    lines.append(rf"\caption{{{_tex(caption(table))}}}")
    lines.append(rf"\begin{{tabular}}{{ll{'r' * len(table.metrics)}}}")
    lines.append(r"\toprule")
    for number, grid in enumerate(grids(table)):
        columns = len(grid.header)
        lines += [r"\midrule"] if number else []
        lines += [rf"\multicolumn{{{columns}}}{{l}}{{\emph{{{grid.mode} mode}}}} \\"] if grid.mode else []
        lines += [" & ".join(map(_tex, grid.header)) + r" \\", r"\midrule"]
        rows = ([*line.head, *map(" ".join, line.cells)] for line in _all(grid))
        lines += [" & ".join(map(_tex, row)) + r" \\" for row in rows]
    lines += [r"\bottomrule", r"\end{tabular}"]
    lines += [rf"\par\smallskip\raggedright\footnotesize {_tex(line)}." for line in _remarks(table)]
    return "\n".join([*lines, r"\end{table}"]) + "\n"


def as_json(table: Table) -> str:
    """Return the table's whole content as JSON, including the values of each seed."""
    fields = asdict(table)
    for row, words in zip(table.rows, fields["rows"], strict=True):
        for mode, cells in row.cells.items():
            for metric, cell in cells.items():
                summary = {"mean": cell.mean, "sd": cell.sd, "agrees": cell.agrees}
                words["cells"][mode][metric] |= summary
    return json.dumps(plain(fields), indent=2, ensure_ascii=False) + "\n"


def show(table: Table, console: Console) -> None:
    """Print the table on a terminal; columns that do not fit are put into further blocks below."""
    console.print(caption(table), style="bold", soft_wrap=True)
    for grid in grids(table):
        if grid.mode:
            console.print(f"{grid.mode} mode", style="italic")
        for columns in _fitting(grid, console.width):
            console.out("\n".join(_lined(grid, columns)), "", sep="\n", highlight=False)
    for line in _remarks(table):
        console.print(f"- {line}")
    console.print()


FORMATS: dict[str, Callable[[Table], str]] = {"md": markdown, "tex": latex, "json": as_json}


def _all(grid: Grid) -> Iterator[VariantLine]:
    return (line for group in grid.groups for line in group)


def _remarks(table: Table) -> list[str]:
    return [*legend(table), *table.flags, *table.notes]


def _tex(text: str) -> str:
    return "".join(TEX.get(letter, letter) for letter in text)


def _fitting(grid: Grid, width: int) -> list[list[int]]:
    """Divide the metrics' columns into as few groups of nearly equal size as fit the width.

    The variants' two columns are repeated before each group.
    """
    columns = range(2, len(grid.header))
    widths = [
        _width(block[column] for block in _blocks(grid)) + len(GAP) for column in range(len(grid.header))
    ]
    for groups in range(1, len(columns) + 1):
        size = -(-len(columns) // groups)
        fits = [list(columns[i : i + size]) for i in range(0, len(columns), size)]
        if all(sum(widths[:2]) + sum(widths[i] for i in group) <= width for group in fits):
            break
    return fits


def _lined(grid: Grid, columns: Sequence[int]) -> Iterator[str]:
    """Yield some columns of a grid as lines. (Rich's table takes seconds for hundreds of variants.)"""
    blocks = [[block[i] for i in (0, 1, *columns)] for block in _blocks(grid)]
    widths = [_width(block[i] for block in blocks) for i in range(len(columns) + 2)]
    for number, block in enumerate(blocks):
        for words in itertools.zip_longest(*block, fillvalue=""):
            padded = [
                word.ljust(widths[i]) if i < 2 else word.rjust(widths[i]) for i, word in enumerate(words)
            ]
            yield GAP.join(padded).rstrip()
        if number == 0:
            yield "─" * (sum(widths) + len(GAP) * (len(widths) - 1))
        elif len(block[1]) > 1:
            yield ""


def _width(parts: Iterable[Sequence[str]]) -> int:
    return max(len(word) for part in parts for word in part)


def _blocks(grid: Grid) -> list[list[Sequence[str]]]:
    return [[*map(_header, grid.header)], *map(_block, grid.groups)]


def _block(group: Sequence[VariantLine]) -> list[Sequence[str]]:
    columns: list[list[str]] = [[] for _ in (0, *group[0].cells)]
    for line in group:
        height = max(map(len, line.cells))
        for column, parts in zip(columns, [(line.head[1],), *line.cells], strict=True):
            column += [*parts, *[""] * (height - len(parts))]
    return [textwrap.wrap(group[0].head[0], LABEL), *columns]


def _header(name: str) -> list[str]:
    metric, _, rest = name.partition(" [")
    unit, _, arrow = rest.partition("] ")
    return [f"{metric} {arrow}", unit] if rest else [name]
