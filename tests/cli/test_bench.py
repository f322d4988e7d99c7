"""`memmlp bench` times every graph and compares two recipes; AvatarPoser is the published network."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import tiny
import torch
from conftest import Memmlp, one_line
from torch import Tensor, nn

from memmlp.cli.bench import GRAPHS, conclude, summarize, summarize_seeds
from memmlp.deploy.latency import InTurn
from memmlp.motion.body import N_JOINTS, SPARSE_DIM

BENCHED = ["profile=tiny", "model.depth=2", "model.heads=4"]


def test_a_summary_by_hand():
    seconds = np.array([[1, 2, 3], [4, 4, 4], [6, 6, 6]]) * 1e-3
    base = InTurn(np.full((3, 2), 2e-3), np.ones(3))
    found = summarize("pose_", InTurn(seconds, np.array([0.98, 0.7, 1.0])), base)
    assert found["pose_median_ms"] == pytest.approx(4)
    assert [found[f"pose_ratio_{key}"] for key in ("least", "most")] == [1, 3]
    assert found["pose_ratio_to_avatar_poser"] == pytest.approx(2)
    assert found["pose_core_share"] == 0.7


class TorchAvatarPoser(nn.Module):
    """AvatarPoser of torch's own layers."""

    def __init__(self, width: int, depth: int, heads: int, feedforward: int):
        super().__init__()
        self.embedding = nn.Linear(SPARSE_DIM, width)
        layer = nn.TransformerEncoderLayer(width, heads, feedforward, batch_first=True)
        self.encoder = nn.TransformerEncoder(layer, depth)
        self.orientation = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 6))
        self.rotation = nn.Sequential(
            nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 6 * (N_JOINTS - 1))
        )

    def forward(self, window: Tensor) -> Tensor:
        newest = self.encoder(self.embedding(window))[:, -1]
        return torch.cat([self.orientation(newest), self.rotation(newest)], -1)


@torch.no_grad()
def test_avatar_poser_is_the_network_of_torch_layers():
    ours = tiny.baseline("avatar_poser")
    weights = {
        name: value
        for name, value in ours.state_dict().items()
        if not name.startswith(("normalizer", "layers"))
    }
    for i, layer in enumerate(ours.layers):
        parts = (layer.attention.query, layer.attention.key, layer.attention.value)
        others = {
            "self_attn.out_proj": layer.attention.out, "linear1": layer.widen, "linear2": layer.narrow,
            "norm1": layer.attention_norm, "norm2": layer.norm,
        }  # fmt: skip
        for kind in ("weight", "bias"):
            start = f"encoder.layers.{i}."
            weights[f"{start}self_attn.in_proj_{kind}"] = torch.cat([getattr(part, kind) for part in parts])
            weights |= {f"{start}{name}.{kind}": getattr(part, kind) for name, part in others.items()}
    theirs = TorchAvatarPoser(width=16, depth=2, heads=4, feedforward=32).eval()
    theirs.load_state_dict(weights)
    window = torch.randn(1, 7, SPARSE_DIM)
    torch.testing.assert_close(theirs(window), ours.predict_rotations(window), atol=1e-5, rtol=1e-5)


@pytest.mark.slow
def test_every_graph_is_timed_and_compared(memmlp: Memmlp, tmp_path):
    file = tmp_path / "rows.json"
    ran = memmlp("bench", "latency", *BENCHED, "--models", "avatar_poser", "--steps", "2", "--json", file)
    assert ran.code == 0, ran.err
    written = json.loads(file.read_text())
    rows = {row["variant"]: row for row in written["rows"]}
    assert written["overrides"] == BENCHED
    assert [written[key] for key in ("rounds", "steps", "threads")] == [5, 2, 1]
    assert all(0 < row["core_share"] < 1.01 and row["median_ms"] > 0 for row in written["rows"])
    assert list(rows) == list(GRAPHS)
    assert rows["network"]["ratio_to_avatar_poser"] == 1
    assert rows["naive"]["pose_ratio_to_avatar_poser"] == 1
    assert [graph for graph, row in rows.items() if "pose_median_ms" in row] == list(GRAPHS[1:])
    assert max(map(len, ran.out.splitlines())) <= 100


def test_models_include_the_one_that_others_are_compared_with(memmlp: Memmlp):
    assert one_line(memmlp("bench", "latency", "--models", "mem_mlp@41"), "--models", "avatar_poser")
    for word in ("model=rpm", "model.frames=9"):
        assert one_line(memmlp("bench", "latency", word), word, "--models")


TINY = (
    "profile=tiny",
    "model.depth=2",
    "data.synth.minutes=0.1",
    "threads=1",
    "memory=none",
    "optim.steps=4",
)


def row(seed: int, current: float, recipe: float | None) -> dict:
    mark = {"steps": 1, "error": 1.0}
    reached = {**mark, "seconds": recipe} if recipe else None
    return {"seed": seed, "current": {**mark, "seconds": current}, "recipe": reached}


def test_ratio_interval_and_verdict_by_hand():
    """Logarithms of 2, 2.5 and 3.125 are equally far apart: ln(1.25). Student's t of 2 degrees is 4.303."""
    rows = [row(0, 20, 10), row(1, 25, 10), row(2, 31.25, 10)]
    found = summarize_seeds(rows, 1.0)
    half = 4.3027 * math.log(1.25) / math.sqrt(3)
    assert found["ratio"] == pytest.approx(2.5)
    assert found["low"] == pytest.approx(2.5 * math.exp(-half), rel=1e-4)
    assert found["verdict"] == "holds"
    assert summarize_seeds(rows, 2.0)["ratio"] == pytest.approx(2.5)
    assert summarize_seeds(rows, 2.0)["verdict"] not in ("holds", "opposite")
    assert summarize_seeds(rows, 9.0)["verdict"] == "opposite"


def test_a_seed_that_never_reached_the_error_leaves_nothing_to_claim():
    found = summarize_seeds([row(0, 20, 1), row(1, 20, 1.1), row(2, 20, None)], 1.0)
    assert (found["ratio"], found["never"]) == (None, [2])
    assert found["verdict"] not in ("holds", "opposite")
    assert "seed 2" in conclude(found)


def test_one_seed_has_no_interval():
    found = summarize_seeds([row(0, 20, 10)], 1.0)
    assert found["low"] is None
    assert conclude(found).startswith("2.00 times sooner in processor seconds (95 % interval: none")


@pytest.mark.slow
def test_two_recipes_are_timed(memmlp: Memmlp, tmp_path: Path):
    file = tmp_path / "found.json"
    recipe = ("--recipe", "optim=muon optim.lr=2e-3", "--every", "2", "--json", str(file))
    ran = memmlp("bench", "train", *recipe, "--seeds", "1", *TINY)
    assert ran.code == 0, ran.err
    (row,) = json.loads(file.read_text())["seeds"]
    assert row["current"]["steps"] in (2, 4)
    assert row["runs"]["current"] != row["runs"]["recipe"]
    changed = ("bench", "train", "--recipe", "data.synth.minutes=0.3", "--seeds", "1", *TINY)
    assert one_line(memmlp(*changed), "--recipe", "the data")
    assert one_line(memmlp("bench", "train", "--recipe", "threads=2"), "--recipe threads", "OVERRIDES")
