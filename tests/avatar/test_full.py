"""The whole way as one ONNX file: that of evaluation, and that of the live stream."""

from __future__ import annotations

from pathlib import Path

import live
import numpy as np
import onnx
import pytest
import tiny
import torch

from memmlp.avatar.full import FullStream, export_full, full_parity, trackers_of
from memmlp.avatar.spaces import SPACES
from memmlp.avatar.stream import Stream
from memmlp.body import SPARSE_DIM
from memmlp.errors import InputError
from memmlp.export import TOLERANCE, export
from memmlp.features import Heading, sparse_features
from memmlp.streaming import streaming

RUN = "0123456789abcdef"
PERSON = live.person(np.arange(61) / 60)


@pytest.mark.parametrize("name", SPACES)
def test_it_is_the_stream(name, tmp_path: Path):
    """In every space, with the whole graph and the streaming one, from a fresh start and after a reset."""
    network, space = tiny.model(coordinates=Heading()), SPACES[name]
    graph = network if name == "openxr" else streaming(network)
    export(graph, tmp_path / "network.onnx", RUN)
    export_full(graph, tmp_path / "full.onnx", RUN, name)
    assert full_parity(network, tmp_path / "full.onnx", PERSON.frames, name) <= TOLERANCE
    positions, rotations = space.positions_out(PERSON.positions), space.rotations_out(PERSON.rotations)
    poses = live.play(Stream(tmp_path / "network.onnx", space=name), positions, rotations)
    full = FullStream(tmp_path / "full.onnx")
    for _ in range(2):
        for index, pose in enumerate(poses):
            given = [part[index : index + 1].astype(np.float32) for part in (positions, rotations)]
            for ours, theirs in zip(
                full.step(*given), (pose.rotations, pose.positions, pose.joints), strict=True
            ):
                np.testing.assert_allclose(ours[0], theirs, atol=1e-4)
        full.reset()


@pytest.mark.parametrize("name", tiny.REFERENCES)
def test_reference_networks_have_it_too(name, tmp_path: Path):
    network = tiny.reference(name)
    export_full(network, tmp_path / "full.onnx", RUN, "unity")
    assert full_parity(network, tmp_path / "full.onnx", PERSON.frames, "unity") <= TOLERANCE


def test_parity_sees_a_difference(tmp_path: Path):
    network = tiny.model()
    export_full(network, tmp_path / "full.onnx", RUN, "unity")
    assert full_parity(network, tmp_path / "full.onnx", PERSON.frames, "openxr") > TOLERANCE
    with torch.no_grad():
        network.stem.bias += 0.1
    assert full_parity(network, tmp_path / "full.onnx", PERSON.frames, "unity") > TOLERANCE


def test_interface_and_metadata(tmp_path: Path):
    export_full(tiny.model(), tmp_path / "full.onnx", RUN, "unity")
    graph = onnx.load(tmp_path / "full.onnx")
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
    with pytest.raises(InputError, match="scope full; allowed here is one of scope network"):
        Stream(tmp_path / "full.onnx")


def test_an_unknown_space_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="space=maya"):
        export_full(tiny.model(), tmp_path / "full.onnx", RUN, "maya")


def test_trackers_of_frames_have_their_features():
    positions, rotations = trackers_of(PERSON.frames.double())
    again = sparse_features(rotations, positions)
    np.testing.assert_allclose(again, PERSON.frames[:, :SPARSE_DIM], atol=1e-6)
