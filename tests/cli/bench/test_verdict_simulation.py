"""`memmlp bench verdicts` simulates what it says, and reports promises that are broken."""

from __future__ import annotations

from pathlib import Path

import pytest

from memmlp.cli.bench import verdict_simulation
from memmlp.common.files import read_json
from memmlp.tables.statistics.simulation import SimulationSetting


def test_the_command(memmlp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(
        verdict_simulation, "grid", lambda: [SimulationSetting(3, 10, 2), SimulationSetting(5, 536, 10)]
    )
    file = tmp_path / "rates.json"
    ran = memmlp("bench", "verdicts", "--quick", "--tables", "30", "--json", str(file), "--markdown")
    assert ran.code == 0, ran.err
    (row,) = read_json(file)["cells"]
    assert (row["seeds"], row["clips"], row["size"], row["groups"]) == (3, 10, 2, 5)
    assert f"| 3 x 10 / 2 | {100 * min(s['coverage'] for s in row['shares'].values()):.1f}-" in ran.out
    monkeypatch.setattr("memmlp.tables.statistics.verdict_error_rates.MOST", 0.8)
    ran = memmlp("bench", "verdicts", "--quick", "--tables", "30")
    assert ran.code == 1
    assert "broken at 3 seeds x 10 clips, 2 a group: coverage" in ran.out
    assert max(map(len, ran.out.splitlines())) < 120
    assert "no folder" in memmlp("bench", "verdicts", "--json", str(tmp_path / "none" / "f")).err
