"""A table's times: of the seeds that had a core to themselves, if there are any."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fake_runs import fake_sweep, table_of

from memmlp.sweep.definition import Sweep


@pytest.mark.parametrize(
    ("shares", "counted"),
    [
        ([0.97, 0.5, None], [0]),
        ([0.7, 0.5, None], [0, 1, 2]),
        ([None, 0.97, 0.95], [1, 2]),
        ([0.95, 0.97, 0.9], [0, 1, 2]),
    ],
)
def test_times_are_of_undisturbed_seeds(
    sweep: Sweep, tmp_path: Path, shares: list[float | None], counted: list[int]
):
    """Seed 0 took 1 ms, seed 1 took 3 ms, and so on; all other columns are of all seeds."""
    find = fake_sweep(tmp_path, sweep)
    for variant in sweep.runnable():
        for seed, share in enumerate(shares):
            path = find(variant, seed).deployment("fp32-0").latency
            known = {"core_share": share} if share is not None else {}
            took = {"median_ms": 1.0 + 2 * seed, "ratio_to_yardstick": 0.6}
            path.write_text(json.dumps(json.loads(path.read_text()) | took | known))
    table = table_of(sweep, find)
    row = table.rows[1]
    cells = row.cells[table.modes[0]]
    assert sorted(cells["ms"].values) == counted
    assert cells["ms"].mean == pytest.approx(sum(1.0 + 2 * seed for seed in counted) / len(counted))
    assert sorted(cells["MPJPE"].values) == [0, 1, 2]
    said = [flag for flag in table.flags if "core to themselves" in flag]
    assert said == (
        [f"times are of the seeds that were timed with a core to themselves: {_each(sweep, len(counted))}"]
        if len(counted) < 3
        else []
    )


def _each(sweep: Sweep, number: int) -> str:
    return ", ".join(f"'{variant.label}' ({number} of 3)" for variant in sweep.runnable())
