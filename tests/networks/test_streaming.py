"""The live stream computes what the trained network does, with less work."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import exported
import pytest
import tiny
import torch

from memmlp.common.components import find
from memmlp.common.errors import InputError
from memmlp.deploy.latency import macs
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.deploy.parity import parity
from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.network_coordinates import Heading, HeadRelative, World
from memmlp.networks.mem_mlp import MemMLP
from memmlp.networks.memory import GRUMemory, LSTMMemory, NoMemory
from memmlp.networks.motion_model import StreamingGraph
from memmlp.networks.own_past_memory import CodeMemory, JointCodeMemory, NoCodesMemory
from memmlp.networks.predictor import RotationOnlySettings, TwoBranchMemorySettings, TwoBranchSettings
from memmlp.networks.streaming import has_stream, streaming

MEMORIES = [
    (NoMemory, {}),
    (NoCodesMemory, {"shift": "frame"}),
    (CodeMemory, {"shift": "frame"}),
    (CodeMemory, {"shift": "window"}),
    (CodeMemory, {"fusion": "plain", "blend": 0.2}),
    (JointCodeMemory, {}),
    (LSTMMemory, {}),
    (GRUMemory, {"fusion": "plain"}),
]
CLIP = tiny.clip(40)[None, :, :SPARSE_DIM]
TWICE = 20  # frames: a full past of each network, which then slides on, and of most twice


def largest_difference(model, sparse: torch.Tensor) -> float:
    """Return the largest difference over a stream (1, N, 54), graph and network each on its own history."""
    live = streaming(model)
    whole, carried, worst = model.initial_state(1), live.initial_state(), 0.0
    for frame in sparse.split(1, 1):
        expected, whole = model.advance(frame, whole, 1)
        found, carried = live.advance(frame, carried)
        worst = max(worst, float((expected - found).abs().max()))
    return worst


@pytest.mark.parametrize(
    ("kind", "changes", "predictor"),
    [
        *((kind, changes, TwoBranchSettings) for kind, changes in MEMORIES),
        (NoMemory, {}, RotationOnlySettings), (CodeMemory, {}, RotationOnlySettings),
        (CodeMemory, {}, TwoBranchMemorySettings), (LSTMMemory, {}, TwoBranchMemorySettings),
        (NoCodesMemory, {"fusion": "plain"}, TwoBranchMemorySettings),
    ],
)  # fmt: skip
@torch.no_grad()
def test_the_stream_is_the_network(kind, changes, predictor):
    model = tiny.model(kind, predictor, **changes).double()
    assert largest_difference(model, CLIP[:, :TWICE].double()) < 1e-11


@pytest.mark.parametrize("predictor", [TwoBranchSettings, RotationOnlySettings])
@torch.no_grad()
def test_of_branches_without_blocks(predictor):
    slot = tiny.memory()
    head = find("predictor", predictor.name).build({"depth": 0}, **tiny.SIZES)
    model = MemMLP(tiny.normalizer(), slot, head, depth=tiny.DEPTH, **tiny.SIZES).eval().double()
    assert largest_difference(model, CLIP.double()) < 1e-11


@pytest.mark.slow
@pytest.mark.parametrize("name", tiny.BASELINES)
@pytest.mark.parametrize(("depth", "coordinates"), [(1, HeadRelative()), (3, Heading())], ids=["1", "3"])
@torch.no_grad()
def test_the_stream_of_a_baseline_is_the_network(name, depth, coordinates):
    """Whether its first layer is its last one, or there is one between them."""
    model = tiny.baseline(name, coordinates, depth=depth).double()
    assert largest_difference(model, CLIP[:, :TWICE].double()) < 1e-11


@pytest.mark.parametrize("coordinates", [World(), HeadRelative(), Heading()])
@torch.no_grad()
def test_in_all_coordinates(coordinates):
    model = tiny.model(coordinates=coordinates).double()
    turning = CLIP.double().clone()
    turning[..., :18] = tiny.clip(40, seed=4, spread=2.0)[None, :, :18]
    assert largest_difference(model, turning) < 1e-11


def test_the_network_itself_stays_as_it_is():
    model = tiny.model()
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    live = streaming(model)
    assert isinstance(live, StreamingGraph)
    assert not any(parameter.requires_grad for parameter in live.parameters())
    assert model.memory.frames == model.frames
    for name, tensor in model.state_dict().items():
        assert torch.equal(tensor, before[name])
    assert any(parameter.requires_grad for parameter in model.parameters())


@torch.no_grad()
def test_less_work():
    """Less than for a whole window; the same where there is no window."""
    for name in ("mem_mlp", *tiny.BASELINES):
        model = tiny.model() if name == "mem_mlp" else tiny.baseline(name)
        counts = [macs(network) for network in (model, streaming(model))]
        assert counts[1] == counts[0] if name in tiny.WINDOWLESS else counts[1] < counts[0], name


class Different(type(tiny.baseline("avatar_poser"))):
    """A network that extends another one, and inherits its graph."""


def test_what_has_no_stream_is_refused():
    with pytest.raises(InputError, match=r"memory\.history=latest"):
        streaming(tiny.model(CodeMemory, history="latest"))
    model = tiny.baseline("avatar_poser")
    model.__class__ = Different
    assert not has_stream(model)
    with pytest.raises(InputError, match=r"export\.graph=streaming"):
        streaming(model)


@pytest.mark.slow
@pytest.mark.parametrize("network", [*exported.NETWORKS, *exported.LARGEST])
def test_its_file_is_the_network_in_onnx_runtime(step_files: Callable[[str], Path], network: str):
    path = step_files(network)
    assert parity((exported.NETWORKS | exported.LARGEST)[network](), path, tiny.clip(40)[:20]) < 1e-4
    assert "state.count" in OnnxStream(path).state
