"""What the live stream refuses, in one line each: trackers, times, options, files."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import onnx
import pytest

from memmlp.common.errors import InputError
from memmlp.evaluation.ik import LBFGS
from memmlp.live.stream import Stream
from memmlp.live.wearer import Offsets

pytestmark = pytest.mark.slow

ONE = ([0, 0, 1.6], np.eye(3))


@pytest.fixture
def file(step_files) -> Path:
    return step_files("no_memory")


@pytest.mark.parametrize(
    ("tracker", "words"),
    [
        (([0, 0], np.eye(3)), "left: a position of shape .2,."),
        (([0, 0, 0], np.eye(4)), "left: a rotation of shape .4, 4."),
        (([0, 0, 0], [0, 0, 0, 2]), "left: a quaternion of norm 2;"),
        (([0, 0, 0], 2 * np.eye(3)), "left: the matrix is not orthonormal"),
        (([0, 0, 0], np.diag([1, 1, -1])), "left: the matrix is a mirror image"),
        ("no", "left: expected .position, rotation."),
        (([0, 0, 0],), "left: expected .position, rotation."),
    ],
)
def test_bad_trackers_are_refused(tracker, words, file):
    with pytest.raises(InputError, match=words):
        Stream(file).step(ONE, tracker, ONE)


def test_bad_times_spaces_and_outputs_are_refused(file):
    for time in (float("nan"), 1e20, -math.inf, "1.0", [1]):
        with pytest.raises(InputError, match="time="):
            Stream(file).step(ONE, ONE, ONE, time)
    for space in ("up", ["amass"]):
        with pytest.raises(InputError, match="space="):
            Stream(file, space=space)
    for source in (None, 5, ""):
        with pytest.raises(InputError, match="source="):
            Stream(source)
    with pytest.raises(InputError, match="rotations=euler"):
        Stream(file, rotations="euler")
    with pytest.raises(InputError, match="offsets: shapes"):
        Stream(file, offsets=Offsets(np.zeros(3), np.eye(3)))
    for offsets in (5, (1, 2, 3), Offsets(np.full((3, 3), np.nan), np.stack([np.eye(3)] * 3))):
        with pytest.raises(InputError, match="offsets: "):
            Stream(file, offsets=offsets)
    with pytest.raises(InputError, match="calibrate: the hands are not apart"):
        Stream(file).calibrate(ONE, ONE, ONE)
    with pytest.raises(InputError, match=r"calibrate: .*left"):
        Stream(file).calibrate(ONE, None, ONE)


def test_bad_files_are_refused(file, tmp_path):
    with pytest.raises(InputError, match="no such file"):
        Stream(tmp_path)
    (tmp_path / "text.onnx").write_text("no network")
    with pytest.raises(InputError, match=r"text\.onnx"):
        Stream(tmp_path / "text.onnx")
    graph = onnx.load(file)
    old = [prop for prop in graph.metadata_props if prop.key != "rest"]
    del graph.metadata_props[:]
    graph.metadata_props.extend(old)
    onnx.save(graph, tmp_path / "old.onnx")
    with pytest.raises(InputError, match="rest; export it again"):
        Stream(tmp_path / "old.onnx")
    del graph.metadata_props[:]
    onnx.save(graph, tmp_path / "foreign.onnx")
    with pytest.raises(InputError, match=r"foreign\.onnx"):
        Stream(tmp_path / "foreign.onnx")


@pytest.mark.parametrize(
    ("key", "value"),
    [("rest", "[1]"), ("rest", "{"), ("joints", "3"), ("fps", "0"), ("fps", "x"), ("T", "1.5")],
)
def test_damaged_metadata_are_refused(key, value, file, tmp_path):
    graph = onnx.load(file)
    onnx.helper.set_model_props(graph, {p.key: p.value for p in graph.metadata_props} | {key: value})
    onnx.save(graph, tmp_path / "damaged.onnx")
    with pytest.raises(InputError, match="damaged"):
        Stream(tmp_path / "damaged.onnx")


@pytest.mark.parametrize(
    ("name", "kind", "shape"),
    [
        ("x", onnx.TensorProto.FLOAT, ["batch", 3]),
        ("x", onnx.TensorProto.STRING, [3]),
        ("state.x", onnx.TensorProto.FLOAT, [3]),
    ],
)
def test_networks_of_other_programs_are_refused(name, kind, shape, tmp_path):
    ends = [onnx.helper.make_tensor_value_info(end, kind, shape) for end in (name, "y")]
    node = onnx.helper.make_node("Identity", [name], ["y"])
    graph = onnx.helper.make_graph([node], "foreign", ends[:1], ends[1:])
    model = onnx.helper.make_model(graph, ir_version=9, opset_imports=[onnx.helper.make_opsetid("", 18)])
    onnx.save(model, tmp_path / "foreign.onnx")
    with pytest.raises(InputError, match=r"foreign\.onnx"):
        Stream(tmp_path / "foreign.onnx")


def test_inverse_kinematics_need_a_position_branch(step_files):
    with pytest.raises(InputError, match="position branch"):
        Stream(step_files("rotation_only"), ik=LBFGS())
