"""What all networks share: calls of any size, both modes, clips side by side, streaming graphs, files."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import exported
import pytest
import tiny
import torch
from conftest import long_except

from memmlp.common.components import find_component
from memmlp.common.errors import InputError
from memmlp.deploy.latency import count_macs
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.deploy.parity import measure_differences
from memmlp.evaluation import modes
from memmlp.motion.body import MOTION_DIM, ROTATION, SPARSE_DIM
from memmlp.motion.network_coordinates import Heading, HeadRelative, World
from memmlp.networks.mem_mlp import MemMLP
from memmlp.networks.memory import FeatureMemory, GRUMemory, LSTMMemory, NoMemory
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.own_past_memory import CodeMemory, JointCodeMemory, MemoryWithoutCodes
from memmlp.networks.predictor import RotationOnlySettings, TwoBranchMemorySettings, TwoBranchSettings
from memmlp.networks.streaming import has_streaming_graph, make_streaming_graph


def without_blocks() -> MemMLP:
    head = find_component("predictor", TwoBranchSettings.name).build({"depth": 0}, **tiny.SIZES)
    return MemMLP(tiny.normalizer(), tiny.memory(), head, depth=tiny.DEPTH, **tiny.SIZES).eval()


MEM_MLP: dict[str, Callable[[], MotionModel]] = {
    "no memory": partial(tiny.model, NoMemory),
    "no codes": partial(
        tiny.model, MemoryWithoutCodes, TwoBranchMemorySettings, fusion="plain", shift="frame"
    ),
    "codes": partial(tiny.model, CodeMemory, coordinates=World(), shift="frame"),
    "codes, window": partial(tiny.model, CodeMemory, RotationOnlySettings, coordinates=Heading()),
    "codes, plain": partial(tiny.model, CodeMemory, TwoBranchMemorySettings, fusion="plain", blend=0.2),
    "joint codes": partial(tiny.model, JointCodeMemory),
    "latest": partial(tiny.model, CodeMemory, history="latest"),
    "lstm": partial(tiny.model, LSTMMemory, TwoBranchMemorySettings),
    "gru": partial(tiny.model, GRUMemory, fusion="plain"),
    "without blocks": without_blocks,
}
NETWORKS: dict[str, Callable[[], MotionModel]] = {
    **MEM_MLP,
    **{name: partial(tiny.baseline, name, Heading()) for name in tiny.BASELINES},
    "avatar_poser, 3 layers": partial(tiny.baseline, "avatar_poser", HeadRelative(), depth=3),
    **{
        f"recurrent {cell}": partial(tiny.recurrent_poser, Heading(), cell=cell)
        for cell in ("gru", "lstm", "mingru", "lru")
    },
    "recurrent, global": partial(tiny.recurrent_poser, Heading(), output="global"),
    "recurrent, reaching": partial(tiny.recurrent_poser, Heading(), output="reaching", members=2),
    "refined": tiny.refined,
    "refined hmd_poser": lambda: tiny.refined(tiny.baseline("hmd_poser", Heading())),
}
LONG, SHORT = tiny.clip(20).double(), tiny.clip(9, seed=3).double()
SPARSE = LONG[None, :, :SPARSE_DIM]


@pytest.mark.parametrize("name", NETWORKS)
@torch.no_grad()
def test_calls_modes_clips_and_the_graph_are_one_stream(name: str):
    """In float64: untrained networks on their own output may amplify float32's rounding."""
    model = NETWORKS[name]().double()
    stream = modes.predict_stream(model, [LONG])[0]
    assert stream.shape == (20, MOTION_DIM)
    together = modes.predict_stream(model, [SHORT, LONG])
    torch.testing.assert_close(together[1], stream, atol=1e-9, rtol=0)
    torch.testing.assert_close(together[0], modes.predict_stream(model, [SHORT])[0], atol=1e-9, rtol=0)
    windows = modes.predict_windows(model, [SHORT, LONG])
    torch.testing.assert_close(windows[0], modes.predict_windows(model, [SHORT])[0], atol=1e-9, rtol=0)
    if "position" not in model.branches:
        expected = model.normalizer.compute_positions(stream, LONG[:, :SPARSE_DIM]).flatten(1)
        torch.testing.assert_close(stream[:, ROTATION.stop :], expected, atol=1e-9, rtol=0)
    if model.windowless:
        torch.testing.assert_close(windows[1], stream, atol=1e-9, rtol=0)
        state, made = model.initial_state(), []
        for part in SPARSE.split([1, 9, 10], 1):
            motion, state = model.advance(part, state)
            made.append(motion[0])
        torch.testing.assert_close(torch.cat(made), stream, atol=1e-9, rtol=0)
    else:  # the first frame fills the window
        still = model.running_state(SPARSE[:, :1].expand(-1, model.past_frames, -1))
        motion = model.advance(SPARSE[:, :1], still, 1)[0]
        torch.testing.assert_close(motion[0, -1], stream[0], atol=1e-9, rtol=0)
    if not model.settled:
        return
    before = {key: tensor.clone() for key, tensor in model.state_dict().items()}
    graph, carried = make_streaming_graph(model), make_streaming_graph(model).initial_state()
    live = []
    for frame in SPARSE.split(1, 1):
        motion, carried = graph.advance(frame, carried)
        live.append(motion[0])
    torch.testing.assert_close(torch.cat(live), stream, atol=1e-9, rtol=0)
    assert all(torch.equal(tensor, before[key]) for key, tensor in model.state_dict().items())


@pytest.mark.parametrize("name", ["mem_mlp", "sage"])
def test_a_step_of_a_streaming_graph_is_less_work_than_a_whole_window(name: str):
    model = tiny.model() if name == "mem_mlp" else tiny.baseline(name)
    assert count_macs(make_streaming_graph(model)) < count_macs(model)


class Different(type(tiny.baseline("avatar_poser"))):
    """A network that extends another one, and inherits its graph."""


def test_a_network_without_a_streaming_graph_is_refused():
    with pytest.raises(InputError, match=r"memory\.history=first"):
        make_streaming_graph(tiny.model(CodeMemory, history="latest"))
    model = tiny.baseline("avatar_poser")
    model.__class__ = Different
    for one in (model, tiny.refined(model), tiny.model(FeatureMemory, layers=())):
        assert not has_streaming_graph(one)
    with pytest.raises(InputError, match=r"export\.graph=streaming"):
        make_streaming_graph(model)


@pytest.mark.slow
@pytest.mark.parametrize("network", long_except(exported.NEEDED, exported.NETWORKS))
def test_its_file_is_the_network_in_onnx_runtime(step_files: Callable[[str], Path], network: str):
    path, model = step_files(network), exported.NETWORKS[network]()
    assert measure_differences(model, path, tiny.clip(20)).max() < 1e-4
    assert "state.count" in OnnxStream(path).state
