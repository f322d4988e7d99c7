"""A sweep and its table of runs with random numbers."""

import io
from pathlib import Path

from rich.console import Console

from memmlp.report.tables.table import Table
from memmlp.report.tables.table_text import print_table

SHIPPED = Path(__file__).parent.parent / "sweeps"
FILE = {
    "title": "Memory & its <parts>",
    "table": 11,
    "notes": ["a note of the file"],
    "seeds": [0, 1, 2],
    "control": "full_model",
    "metrics": ["MPJRE", "MPJPE", "Jitter", "FLOPs", "ms"],
    "variants": {
        "a system": {"overrides": None, "paper": {"MPJPE": 4.0}},
        "no | memory": {"overrides": ["memory=none"], "paper": {"MPJRE": 2.76, "MPJPE": 3.0, "Jitter": 7.0}},
        "by position": {"branch": "position", "overrides": ["a=b"], "note": "as <printed>"},
        "full_model": {"overrides": [], "paper": {"MPJRE": 2.57, "MPJPE": 3.08, "Jitter": 7.0}},
    },
}  # fmt: skip
EFFECTS = {"no | memory": 1.2}


def cell(table: Table, label: str, metric: str, mode: str = "stream"):
    return next(row for row in table.rows if row.label == label).cells[mode][metric]


def printed(table: Table, width: int) -> str:
    console = Console(width=width, markup=False, highlight=False, file=io.StringIO())
    print_table(table, console)
    return console.file.getvalue()  # type: ignore[attr-defined]
