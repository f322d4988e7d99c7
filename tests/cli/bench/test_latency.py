"""`memmlp bench latency`: AvatarPoser alone takes the time of the same layers, written by others."""

import json
import re

import numpy as np
import onnx
import pytest
import tiny
import torch
from conftest import Memmlp, one_line

from memmlp.cli.bench.latency import CHECK, VARIANTS, busy, show, summary
from memmlp.cli.bench.torch_avatar_poser import TorchAvatarPoser, export_plainly
from memmlp.deploy.latency import InTurn
from memmlp.motion.body import SPARSE_DIM
from memmlp.networks.avatar_poser import AvatarPoser

BENCHED = ["profile=tiny", "model.depth=2", "model.heads=4"]


def test_a_summary_by_hand():
    seconds = np.array([[1, 2, 3], [4, 4, 4], [6, 6, 6]]) * 1e-3
    base = InTurn(np.full((3, 2), 2e-3), np.ones(3))
    found = summary("pose_", InTurn(seconds, np.array([0.98, 0.7, 1.0])), base)
    assert found["pose_median_ms"] == pytest.approx(4)
    assert [found[f"pose_ratio_{key}"] for key in ("least", "most")] == [1, 3]
    assert found["pose_ratio_to_avatar_poser"] == pytest.approx(2)
    assert found["pose_core_share"] == 0.7


def test_rows_that_had_no_core_of_their_own_are_named(capsys: pytest.CaptureFixture[str]):
    """Whether it was their steps or their poses that waited; the least share has a column."""
    times = {"median_ms": 4.0, "p95_ms": 4.1, "ratio_to_avatar_poser": 1, "ratio_least": 1, "ratio_most": 1}
    poses = {"pose_median_ms": 4.2, "pose_ratio_to_avatar_poser": 1.1, "pose_core_share": 0.52}
    quiet = {"model": "rpm", "variant": "network", **times, "core_share": 0.97}
    waited = {"model": "rpm", "variant": "int8", **times, **poses, "core_share": 0.93}
    assert busy([quiet]) == ""
    assert busy([quiet, waited]) == (
        "timed on a busy machine, so that other work is in the times and ratios: "
        "'rpm int8' (had a core for 52 % of the time)"
    )
    show([quiet, waited], 5)
    shown = [line.split()[-1] for line in capsys.readouterr().out.splitlines()[-3:]]
    assert shown == ["core", "97", "52"]


def weights_of_torch(ours: AvatarPoser) -> dict[str, torch.Tensor]:
    """The weights of a network under the names of torch's own layers."""
    made = {}
    for name, value in ours.state_dict().items():
        if not name.startswith(("normalizer", "layers")):
            made[name] = value
    for i, layer in enumerate(ours.layers):
        parts = (layer.attention.query, layer.attention.key, layer.attention.value)
        others = {
            "self_attn.out_proj": layer.attention.out, "linear1": layer.widen, "linear2": layer.narrow,
            "norm1": layer.attention_norm, "norm2": layer.norm,
        }  # fmt: skip
        for kind in ("weight", "bias"):
            start = f"encoder.layers.{i}."
            made[f"{start}self_attn.in_proj_{kind}"] = torch.cat([getattr(part, kind) for part in parts])
            made |= {f"{start}{name}.{kind}": getattr(part, kind) for name, part in others.items()}
    return made


@pytest.mark.slow
def test_its_layers_share_no_weights(tmp_path):
    """Else a runtime reads one layer's weights for all of them, which is quicker than any trained network."""
    network = TorchAvatarPoser(frames=10, width=16, depth=2, heads=4, feedforward=64)  # that of BENCHED
    export_plainly(network, tmp_path / "network.onnx")
    first, second = (layer.linear1.weight for layer in network.encoder.layers)
    assert not torch.equal(first, second)
    weights = [
        t
        for t in onnx.load(tmp_path / "network.onnx").graph.initializer
        if list(t.dims) in ([64, 16], [16, 64])
    ]
    assert len({t.SerializeToString() for t in weights}) == 4


@torch.no_grad()
def test_the_independent_network_is_the_same():
    ours = tiny.baseline("avatar_poser")
    theirs = TorchAvatarPoser(frames=7, width=16, depth=2, heads=4, feedforward=32).eval()
    theirs.load_state_dict(weights_of_torch(ours))
    window = torch.randn(1, 7, SPARSE_DIM)
    torch.testing.assert_close(theirs(window), ours.rotations(window), atol=1e-5, rtol=1e-5)


@pytest.mark.slow
def test_every_graph_is_timed_and_compared(memmlp: Memmlp, tmp_path):
    file = tmp_path / "rows.json"
    said = memmlp("bench", "latency", *BENCHED, "--models", "avatar_poser", "--steps", "2", "--json", file)
    written = json.loads(file.read_text())
    rows = {(row["model"], row["variant"]): row for row in written["rows"]}
    assert written["overrides"] == BENCHED
    assert [written[key] for key in ("rounds", "steps", "threads")] == [5, 2, 1]
    assert all(0 < row["core_share"] < 1.01 for row in written["rows"])
    assert written["made_by"]["cores"] > 0
    assert said.code == 0
    assert list(rows) == [*(("avatar_poser", variant) for variant in VARIANTS), CHECK]
    assert rows["avatar_poser", "network"]["ratio_to_avatar_poser"] == 1
    assert rows["avatar_poser", "naive"]["pose_ratio_to_avatar_poser"] == 1
    assert all(row["median_ms"] > 0 for row in rows.values())
    timed = [key[1] for key, row in rows.items() if "pose_median_ms" in row]
    assert timed == list(VARIANTS[1:])
    assert re.search(r"^avatar_poser +torch +\d", said.out, re.MULTILINE)
    assert max(map(len, said.out.splitlines())) <= 100


def test_the_control_can_not_be_left_out(memmlp: Memmlp):
    assert one_line(memmlp("bench", "latency", "--models", "mem_mlp_41"), "avatar_poser")
    for word in ("model=rpm", "model.frames=9"):
        assert one_line(memmlp("bench", "latency", word), word, "--models names the networks")
