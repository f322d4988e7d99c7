"""From a sweep and its runs to a table."""

from __future__ import annotations

import functools
import sys
from pathlib import Path

from fake_runs import fake_sweep, runs_of
from fake_table import SHIPPED, printed
from processes import finished

from memmlp.sweep.spec import Sweep, load_sweep, parse_sweep
from memmlp.tables.build_table import without_runs
from memmlp.tables.measured_run import load


def test_collect_reads_each_run_once(sweep: Sweep, tmp_path: Path):
    """The work is linear in the runs: each is read once, though it is in many comparisons."""
    many = parse_sweep("many", {"axes": {"optim.lr": list(range(1, 41))}, "seeds": [0, 1]})
    find, opened = fake_sweep(tmp_path, many), []

    def counted(folder: Path):
        opened.append(folder)
        return load(folder)

    runs_of(many, find, functools.cache(counted))
    assert len(opened) == len(set(opened)) == 80


def test_tables_need_no_torch():
    """Tables need no scipy.stats, matplotlib or Hydra either, for these take seconds to import."""
    code = "import sys, memmlp.cli.table, memmlp.tables.formats as r; print(*sys.modules)"
    ran = finished([sys.executable, "-c", code])
    assert ran.returncode == 0, ran.stderr
    assert not {"torch", "scipy.stats", "matplotlib", "hydra"} & set(ran.stdout.split())


def test_without_runs_the_papers_values_and_the_reason_are_shown():
    table = without_runs(
        load_sweep(SHIPPED / "table01.yaml"), ("stream", "window"), "nothing measured: data.root"
    )
    text = printed(table, 100)
    assert "nothing measured: data.root" in text
    assert "14.27" in text
    assert "missing" not in text
