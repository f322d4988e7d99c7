"""The summary that a sweep leaves in its folder for later readers: its table, aggregates and verdicts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from memmlp.common.files import atomic_write, write_json
from memmlp.sweep.plan import Plan
from memmlp.tables.formats import FORMATS
from memmlp.tables.table import Cell, Table


def write_summary(plan: Plan, table: Table, folder: Path) -> None:
    """Write table.md, table.html and summary.json of a sweep, whose runs need not all be done."""
    folder.mkdir(parents=True, exist_ok=True)
    for form in ("md", "html"):
        atomic_write(folder / f"table.{form}", FORMATS[form](table))
    write_json(folder / "summary.json", summary(plan, table))


def summary(plan: Plan, table: Table) -> dict[str, Any]:
    """Return a sweep's status and runs' labels, and means over seeds and verdicts by LABEL/MODE/METRIC."""
    cells = {
        f"{row.label}/{mode}/{metric}": cell
        for row in table.rows
        for mode, metrics in row.cells.items()
        for metric, cell in metrics.items()
    }
    return {
        "name": plan.name,
        "status": _status(plan),
        "labels": _labels(plan),
        "aggregates": {key: cell.mean for key, cell in cells.items() if cell.mean is not None},
        "verdicts": {key: verdict for key, cell in cells.items() if (verdict := _verdict(cell))},
    }


def _status(plan: Plan) -> str:
    """Return "failed" if a run failed, "running" while one is worked on, "stopped" or "done"."""
    states = plan.counts()
    return next(
        (word for word in ("failed", "running") if states[word]), "stopped" if plan.left() else "done"
    )


def _labels(plan: Plan) -> dict[str, str]:
    """Return the labels of each started run: all variants that use this run."""
    labels: dict[str, dict[str, None]] = {}
    for entry in plan.entries:
        if plan.run_of(entry).manifest:
            labels.setdefault(entry.id, {})[entry.label] = None
    return {run: ", ".join(found) for run, found in labels.items()}


def _verdict(cell: Cell) -> str | None:
    return str(cell.effect.verdict.value) if cell.effect and cell.effect.verdict else None
