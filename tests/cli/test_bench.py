"""`memmlp bench` times every graph and a training step; AvatarPoser is the published network."""

import json

import numpy as np
import pytest
from conftest import Memmlp, one_line

from memmlp.cli.bench import GRAPHS, summarize
from memmlp.deploy.latency import RoundTimes

BENCHED = ["profile=tiny", "model.depth=2", "model.heads=4"]


def test_a_summary_by_hand():
    seconds = np.array([[1, 2, 3], [4, 4, 4], [6, 6, 6]]) * 1e-3
    base = RoundTimes(np.full((3, 2), 2e-3), np.ones(3))
    found = summarize("pose_", RoundTimes(seconds, np.array([0.98, 0.7, 1.0])), base)
    assert found["pose_median_ms"] == pytest.approx(4)
    assert [found[f"pose_ratio_{key}"] for key in ("least", "most")] == [1, 3]
    assert found["pose_ratio_to_avatar_poser"] == pytest.approx(2)
    assert found["pose_core_share"] == 0.7


@pytest.mark.long
def test_every_graph_is_timed_and_compared(memmlp: Memmlp, tmp_path):
    file = tmp_path / "rows.json"
    ran = memmlp("bench", "latency", *BENCHED, "--models", "avatar_poser", "--steps", "2", "--json", file)
    assert ran.code == 0, ran.err
    written = json.loads(file.read_text())
    rows = {row["variant"]: row for row in written["rows"]}
    assert written["overrides"] == BENCHED
    assert [written[key] for key in ("rounds", "steps", "threads")] == [5, 2, 1]
    assert all(0 < row["core_share"] < 1.01 and row["median_ms"] > 0 for row in written["rows"])
    assert (list(rows), rows["network"]["ratio_to_avatar_poser"]) == (list(GRAPHS), 1)
    assert rows["naive"]["pose_ratio_to_avatar_poser"] == 1
    assert [graph for graph, row in rows.items() if "pose_median_ms" in row] == list(GRAPHS[1:])
    assert max(map(len, ran.out.splitlines())) <= 100


def test_models_include_the_one_that_others_are_compared_with(memmlp: Memmlp):
    assert one_line(memmlp("bench", "latency", "--models", "mem_mlp@41"), "--models", "avatar_poser")
    for word in ("model=rpm", "model.frames=9"):
        assert one_line(memmlp("bench", "latency", word), word, "--models")


@pytest.mark.slow
def test_a_training_step_is_timed_beside_its_products(memmlp: Memmlp):
    assert one_line(memmlp("bench", "train", "profile=tiny", "refiner=sage"), "refiner")
    ran = memmlp("bench", "train", "profile=tiny", "--rounds", "1", "--steps", "2")
    assert ran.code == 0, ran.err
    _, step, products, ratio = (line.split() for line in ran.out.splitlines()[-4:])
    assert float(ratio[0]) == pytest.approx(float(step[0]) / float(products[0]), rel=0.1)
