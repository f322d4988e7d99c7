"""The whole way as one ONNX file: it equals that of evaluation, and the live stream."""

from __future__ import annotations

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
from memmlp.deploy.opsets import OPSETS, convert_opset
from memmlp.deploy.parity import TOLERANCE
from memmlp.live.rotations import matrix_to_quaternion
from memmlp.live.spaces import SPACES
from memmlp.live.stream import Stream
from memmlp.live.trackers_to_body_graph import (
    convert_to_quaternions,
    export_full,
    measure_full_differences,
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
    """The whole way in Unity's space, and that of the smallest network in OpenXR's."""
    folder = tmp_path_factory.mktemp("full")
    copyfile(step_files("mem_mlp", "unity"), folder / "unity.onnx")
    copyfile(step_files("no_memory", "openxr"), folder / "openxr.onnx")
    assert exported.data_dependent(onnx.load(folder / "unity.onnx").graph) == set()
    return folder


@pytest.mark.parametrize("name", SPACES)
def test_it_is_the_stream(name, folder: Path, step_files):
    """It holds in every space, from a fresh start and after a reset; in one for the graph as it was trained.

    The other spaces, which know nothing of the network, have the smallest, and so has that graph.
    """
    file, space = folder / f"{name}.onnx", SPACES[name]
    kind = "mem_mlp" if name == "unity" else "no_memory"
    network = exported.NETWORKS[kind]()
    if not file.exists():
        export_full(network, file, RUN, name)
    assert measure_full_differences(network, file, PERSON.frames, name).max() <= TOLERANCE
    positions, rotations = (
        space.convert_positions_from_amass(PERSON.positions),
        space.convert_rotations_from_amass(PERSON.rotations),
    )
    poses = wearer.play(Stream(step_files(kind), space=name), positions, rotations)
    full = OnnxStream(file)
    for _ in range(2):
        for index, pose in enumerate(poses):
            given = [part[index : index + 1].astype(np.float32) for part in (positions, rotations)]
            expected = (pose.rotations, pose.positions, pose.position_branch)
            for ours, theirs in zip(full.step(*given), expected, strict=True):
                np.testing.assert_allclose(ours[0], theirs, atol=1e-4)
        full.reset()


def test_a_baseline_has_it_too(tmp_path: Path):
    """As it was trained, too: without operators whose work depends on the data, and in other opsets."""
    network, file = exported.NETWORKS["avatar_poser"](), tmp_path / "full.onnx"
    export_full(network, file, RUN, "unity")
    native = onnx.load(file)
    assert exported.data_dependent(native.graph) == set()
    for opset in (15, OPSETS[-1]):
        onnx.save(convert_opset(native, opset), file)
        assert measure_full_differences(network, file, PERSON.frames[:30], "unity").max() <= TOLERANCE


def test_quaternions_come_out_on_demand(folder: Path):
    """They are those of the live stream, up to the sign."""
    file, network = folder / "quaternion.onnx", exported.NETWORKS["no_memory"]()
    export_full(make_streaming_graph(network), file, RUN, "openxr", "quaternion", opset=15)
    assert measure_full_differences(network, file, PERSON.frames, "openxr").max() <= TOLERANCE
    graph = onnx.load(file)
    onnx.checker.check_model(graph, full_check=True)
    (output,) = (output for output in graph.graph.output if output.name == "rotations")
    assert [d.dim_value for d in output.type.tensor_type.shape.dim] == [1, 22, 4]
    assert {p.key: p.value for p in graph.metadata_props}["rotations"] == "quaternion"
    assert exported.data_dependent(graph.graph) == set()
    matrices, quaternion = OnnxStream(folder / "openxr.onnx"), OnnxStream(file)
    space = SPACES["openxr"]
    trackers = (
        space.convert_positions_from_amass(PERSON.positions),
        space.convert_rotations_from_amass(PERSON.rotations),
    )
    for frame in range(20):
        given = [part[frame : frame + 1].astype(np.float32) for part in trackers]
        expected = matrix_to_quaternion(matrices.step(*given)[0][0].astype(np.float64))
        found = quaternion.step(*given)[0][0]
        same = np.minimum(np.abs(found - expected).max(1), np.abs(found + expected).max(1))
        assert same.max() < 1e-5


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
    assert measure_full_differences(network, file, PERSON.frames, "openxr").max() > TOLERANCE
    other = copy.deepcopy(network)
    with torch.no_grad():
        other.stem.bias += 0.1
    assert measure_full_differences(other, file, PERSON.frames, "unity").max() > TOLERANCE


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
        "tracker_positions": [1, 3, 3],
        "tracker_rotations": [1, 3, 3, 3],
        "rotations": [1, 22, 3, 3],
        "positions": [1, 22, 3],
        "joints": [1, 22, 3],
    }
    props = {p.key: p.value for p in graph.metadata_props}
    assert (props["scope"], props["space"], props["run_id"]) == ("full", "unity", RUN)
    with pytest.raises(InputError, match="scope full"):
        Stream(folder / "unity.onnx")
    with pytest.raises(InputError, match="rotations=euler"):
        export_full(tiny.model(), folder / "euler.onnx", RUN, "unity", "euler")
