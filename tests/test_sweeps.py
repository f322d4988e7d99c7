"""The shipped sweep files: they load, their arms differ, and their paper values are those printed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from memmlp.sweep.spec import Sweep, load_sweep

FOLDER = Path(__file__).parent.parent / "sweeps"
FILES = sorted(FOLDER.glob("*.yaml"))
TABLES = [path for path in FILES if path.stem.startswith("table")]
PAPER = Path(__file__).parent.parent.parent / "shared" / "paper" / "mem-mlp.txt"
NUMBER = re.compile(r"\d+\.\d+")
LABELLED = (1, 2, 3, 11, 14, 15, 16, 17)  # tables whose labels are the printed ones


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_arms_differ(path: Path):
    sweep = load_sweep(path)
    runnable = [(arm.overrides, arm.branch) for arm in sweep.arms if arm.overrides is not None]
    assert len(set(runnable)) == len(runnable)
    assert path.stem != sweep.title


@pytest.mark.parametrize("path", TABLES, ids=lambda path: path.stem)
def test_tables_carry_their_number_and_values(path: Path):
    sweep = load_sweep(path)
    assert path.stem == f"table{sweep.table:02}"
    assert all(arm.paper for arm in sweep.arms)
    assert all(metric in sweep.metrics for arm in sweep.arms for metric in arm.paper or {})


def test_every_table_of_the_paper_is_there():
    assert [load_sweep(path).table for path in TABLES] == list(range(1, 18))


@pytest.mark.parametrize("path", TABLES, ids=lambda path: path.stem)
def test_values_are_those_printed(path: Path):
    if not PAPER.is_file():
        pytest.skip("the paper's text is not here")
    sweep = load_sweep(path)
    assert sweep.table
    rows = printed(sweep.table)
    assert len(rows) == len(sweep.arms)
    columns = [metric for metric in sweep.metrics if any(metric in (arm.paper or {}) for arm in sweep.arms)]
    for arm, cells in zip(sweep.arms, rows, strict=True):
        values = [number(cell) for cell in cells[-len(columns) :]]
        assert [(arm.paper or {}).get(metric) for metric in columns] == values, arm.label
        if sweep.table in LABELLED:
            assert arm.label == re.sub(r"\s*\[\d+\]", "", cells[0]).strip()


@pytest.mark.parametrize("table", [12, 13])
def test_wrong_heads_are_noted(table: int):
    sweep: Sweep = load_sweep(FOLDER / f"table{table}.yaml")
    assert sweep.metrics == ("MPJRE", "MPJPE", "MPJVE", "Jitter")
    assert any("printed heads" in note for note in sweep.notes)


def printed(table: int) -> list[list[str]]:
    """The cells of a table's rows: the lines with tabs and numbers between its head and its caption."""
    lines = PAPER.read_text(encoding="utf-8").splitlines()
    caption = next(i for i, line in enumerate(lines) if line.startswith(f"Table {table}. "))
    rows: list[list[str]] = []
    for line in reversed(lines[:caption]):
        if "\t" in line and NUMBER.search(line):
            rows.insert(0, line.split("\t"))
        elif rows:
            return rows
    return rows


def number(cell: str) -> float | None:
    """The number of a cell, less its markup and its unit; None for a dash."""
    found = NUMBER.search(cell)
    return float(found[0]) if found else None
