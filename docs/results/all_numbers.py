"""All numbers of a table as CSV."""

from collections.abc import Iterator, Mapping, Sequence

from memmlp.common.text_formats import format_csv
from memmlp.report.tables.table import Cell, Effect, Row, Table
from memmlp.report.tables.table_text import find_unit
from memmlp.sweep.definition import COSTS

CSV_HEADINGS = (
    "test clips", "variant", "mode", "branch", "metric", "unit", "seeds", "planned seeds", "clips", "mean",
    "sd", "low", "high", "compared with", "its branch", "difference", "difference low", "difference high",
    "p", "corrected p", "bootstrap p", "equivalence p", "verdict", "decided at seeds", "detectable",
    "groups", "groups above", "paper", "paper difference", "confounded",
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
    names = ("mean", "low", "high", "p", "holm", "bootstrap", "equal", "verdict", "decided", "detectable")
    line = [row.label, *head, find_unit(head[-1]), *numbers, *((row.against, other) if effect else ("", ""))]
    line += [getattr(effect, name) if effect else "" for name in names]
    line += [effect.groups, effect.groups_above] if effect and effect.groups else ["", ""]
    line += [cell.paper, cell.paper_effect] if cell else ["", ""]
    return [_shorten(one) for one in (*line, row.confounded)]


def _shorten(value: object) -> object:
    """Return a number with five significant digits, and an empty text for None."""
    return f"{value:.5g}" if isinstance(value, float) else "" if value is None else str(value)
