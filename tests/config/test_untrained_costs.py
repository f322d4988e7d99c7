"""Sizes of networks that were not trained, in the place of runs."""

from pathlib import Path

import pytest
from conftest import Memmlp, one_line
from fake_runs import fake_run

from memmlp.config.build import build_untrained
from memmlp.config.untrained_costs import measure_untrained_variants
from memmlp.report.tables.build_table import make_table
from memmlp.report.tables.measured_run import load_measured_run
from memmlp.sweep.sweep_file import parse_sweep

ARMS = {"Mem-MLP": [], "AvatarPoser": ["model=avatar_poser"], "printed alone": {"overrides": None}}
METRICS = ["FLOPs", "MACs", "size", "parameters"]
SWEEP = parse_sweep("sizes", {"variants": ARMS, "metrics": METRICS, "base": ["profile=tiny"], "seeds": [3]})


@pytest.mark.long
def test_networks_without_a_run_are_measured_and_said_to_be_untrained(tmp_path: Path):
    run = load_measured_run(fake_run(tmp_path, "mine", 3).folder)
    runs, flags = measure_untrained_variants(SWEEP, {"Mem-MLP": {3: run}, "AvatarPoser": {}})
    assert runs["Mem-MLP"] == {3: run}
    assert flags == ("networks that were not trained, with random weights: 'AvatarPoser'",)
    (seed, found), *others = runs["AvatarPoser"].items()
    assert (seed, others, found.means) == (3, [], {})
    model = build_untrained(["profile=tiny", "model=avatar_poser"])
    numbers = sum(parameter.numel() for parameter in model.parameters())
    assert found.costs["parameters"] == pytest.approx(numbers / 1e6)
    assert found.costs["FLOPs"] == pytest.approx(2 * found.costs["MACs"])
    assert found.costs["size"] > 4 * found.costs["parameters"]
    table = make_table(SWEEP, runs)
    assert not [flag for flag in table.flags if "not evaluated" in flag or "missing" in flag]


def test_the_command_refuses_it_for_other_tables(memmlp: Memmlp):
    said = memmlp("table", "5", "--untrained")
    assert one_line(said, "--untrained: sweep table05 shows MPJRE, MPJPE", "FLOPs, MACs")
