"""The whole way as one ONNX file: it equals that of evaluation, and the live stream."""

import copy
from pathlib import Path
from shutil import copyfile

import exported
import numpy as np
import onnx
import pytest
import tiny
import torch
import wearer

from memmlp.common.errors import InputError
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.deploy.parity import TOLERANCE
from memmlp.live.rotations import matrix_to_quaternion, quaternion_to_matrix
from memmlp.live.spaces import SPACES
from memmlp.live.stream import Stream
from memmlp.live.trackers_to_body_graph import (
    convert_to_quaternions,
    export_full,
    measure_full_graph_differences,
)
from memmlp.motion.geometry import axis_angle_to_matrix
from memmlp.networks.streaming import make_streaming_graph

pytestmark = pytest.mark.slow

RUN = "0123456789abcdef"
PERSON = wearer.person(np.arange(61) / 60)


@pytest.fixture(scope="module")
def network():
    return exported.NETWORKS["mem_mlp"]()


@pytest.fixture(scope="module")
def folder(step_files, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("full")
    for network, space in (("mem_mlp", "unity"), ("no_memory", "openxr")):
        copyfile(step_files(network, space), folder / f"{space}.onnx")
    assert exported.data_dependent(onnx.load(folder / "unity.onnx").graph) == set()
    return folder


@pytest.mark.parametrize(
    ("name", "kind"), [("unity", "mem_mlp"), ("openxr", "no_memory"), ("amass", "no_memory")]
)
def test_it_is_the_stream(name: str, kind: str, folder: Path, step_files):
    """It holds in every space, from a fresh start and after a reset; in one with quaternions."""
    file, space, network = folder / f"{name}.onnx", SPACES[name], exported.NETWORKS[kind]()
    if name == "amass":
        export_full(make_streaming_graph(network), file, RUN, name, "quaternion", opset=15)
        check_quaternions(onnx.load(file))
    assert measure_full_graph_differences(network, file, PERSON.frames, name).max() <= TOLERANCE
    positions = space.convert_positions_from_amass(PERSON.positions)
    rotations = space.convert_rotations_from_amass(PERSON.rotations)
    poses = wearer.play(Stream(step_files(kind), space=name), positions, rotations)
    full = OnnxStream(file)
    for _ in range(2):
        for index, pose in enumerate(poses):
            given = [part[index : index + 1].astype(np.float32) for part in (positions, rotations)]
            turns, *joints = (made[0] for made in full.step(*given))
            turns = quaternion_to_matrix(turns.astype(float)) if name == "amass" else turns
            expected = (pose.rotations, pose.positions, pose.position_branch)
            for ours, theirs in zip((turns, *joints), expected, strict=True):
                np.testing.assert_allclose(ours, theirs, atol=1e-4)
        full.reset()


def check_quaternions(graph: onnx.ModelProto) -> None:
    onnx.checker.check_model(graph, full_check=True)
    (output,) = (output for output in graph.graph.output if output.name == "rotations")
    assert [d.dim_value for d in output.type.tensor_type.shape.dim] == [1, 22, 4]
    assert {p.key: p.value for p in graph.metadata_props}["rotations"] == "quaternion"
    assert exported.data_dependent(graph.graph) == set()


def test_quaternions_are_exact_at_every_angle():
    axes = np.random.default_rng(0).normal(size=(600, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    small = np.logspace(-12, -1, 200)
    angles = np.concatenate([np.linspace(0, np.pi, 200), small, np.pi - small])
    matrices = axis_angle_to_matrix(torch.tensor(axes * angles[:, None]))
    found = convert_to_quaternions(matrices).numpy()
    expected = matrix_to_quaternion(matrices.numpy())
    same = np.minimum(np.abs(found - expected).max(1), np.abs(found + expected).max(1))
    assert same.max() < 1e-14
    assert (found[:, 3] >= 0).all()


def test_parity_sees_a_difference(network, folder: Path):
    file = folder / "unity.onnx"
    assert measure_full_graph_differences(network, file, PERSON.frames, "openxr").max() > TOLERANCE
    other = copy.deepcopy(network)
    with torch.no_grad():
        other.stem.bias += 0.1
    assert measure_full_graph_differences(other, file, PERSON.frames, "unity").max() > TOLERANCE


def test_interface_and_metadata(folder: Path):
    graph = onnx.load(folder / "unity.onnx")
    shapes = {
        part.name: [d.dim_value for d in part.type.tensor_type.shape.dim]
        for part in (*graph.graph.input, *graph.graph.output)
    }
    states = {name for name in shapes if name.startswith("state.") and not name.endswith(".next")}
    assert all(shapes[f"{name}.next"] == shapes[name] for name in states)
    rest = {name: shape for name, shape in shapes.items() if not name.startswith("state.")}
    assert rest == {
        "tracker_positions": [1, 3, 3], "tracker_rotations": [1, 3, 3, 3], "rotations": [1, 22, 3, 3],
        "positions": [1, 22, 3], "joints": [1, 22, 3],
    }  # fmt: skip
    props = {p.key: p.value for p in graph.metadata_props}
    assert (props["scope"], props["space"], props["run_id"]) == ("full", "unity", RUN)
    with pytest.raises(InputError, match="scope full"):
        Stream(folder / "unity.onnx")
    with pytest.raises(InputError, match="rotations=euler"):
        export_full(tiny.model(), folder / "euler.onnx", RUN, "unity", "euler")
