"""The ONNX step: the same numbers on a whole clip, its interface, its latency."""

import json

import onnx
import pytest
import tiny

from memmlp.deploy.parity import TOLERANCE, measure_differences
from memmlp.motion.body import JOINTS

pytestmark = pytest.mark.slow

CLIP = tiny.clip(50)


def test_numbers_interface_and_metadata(naive_step):
    model, path = naive_step
    assert measure_differences(model, path, CLIP).max() <= TOLERANCE
    graph = onnx.load(path)
    inputs = {i.name: [d.dim_value for d in i.type.tensor_type.shape.dim] for i in graph.graph.input}
    outputs = {o.name: [d.dim_value for d in o.type.tensor_type.shape.dim] for o in graph.graph.output}
    states = {name: list(tensor.shape) for name, tensor in model.initial_state(1).items()}
    assert inputs == {"sparse": [1, 54]} | {f"state.{name}": shape for name, shape in states.items()}
    assert outputs == {"rotation6d": [1, 22, 6], "position": [1, 22, 3]} | {
        f"state.{name}.next": shape for name, shape in states.items()
    }
    props = {p.key: p.value for p in graph.metadata_props}
    assert json.loads(props["joints"]) == list(JOINTS)
    assert (props["fps"], props["T"], props["run_id"]) == ("60", "7", "0" * 16)
    assert "features" in props
    assert "memmlp_version" in props
