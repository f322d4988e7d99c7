"""Seeds that the paper's effects need."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from fake_runs import CLIPS, fake_sweep, runs_of

from memmlp.sweep.definition import MODES, Sweep
from memmlp.tables.seeds_needed import needs


def test_seeds_that_the_papers_effects_need(sweep: Sweep, tmp_path: Path):
    find = fake_sweep(tmp_path, sweep)
    found = {(n.label, n.mode, n.metric): n for n in needs(sweep, runs_of(sweep, find))}
    assert {key[::2] for key in found} == {("no | memory", "MPJRE"), ("no | memory", "MPJPE")}
    big = replace(sweep.variants[1], paper={"MPJRE": 9.0, "MPJPE": 9.0})
    louder = replace(sweep, variants=(sweep.variants[0], big, *sweep.variants[2:]))
    fewer = {(n.label, n.mode, n.metric): n for n in needs(louder, runs_of(louder, find))}
    for key, need in found.items():
        assert need.have == 3
        assert fewer[key].seeds <= (need.seeds or 1000)
    assert fewer["no | memory", "stream", "MPJPE"].seeds <= 3 < found["no | memory", "stream", "MPJPE"].seeds
    runs = runs_of(sweep, find)
    alone = needs(sweep, {**runs, "by position": {}})
    assert needs(sweep, {**runs, "by position": {0: runs["by position"][0]}}) == alone  # it has no p-values
    assert needs(replace(sweep, seeds=(0,)), runs_of(replace(sweep, seeds=(0,)), find)) == []
    for mode in MODES:  # the table's own correction is over both, whichever is shown
        assert needs(sweep, runs, (mode,)) == [need for need in found.values() if need.mode == mode]
    one = fake_sweep(tmp_path / "one", sweep, groups=dict.fromkeys(CLIPS, "one"))
    assert needs(sweep, runs_of(sweep, one)) == []
