"""The ONNX step: the same numbers on a whole clip, its interface, its latency."""

import json
import logging

import onnx
import pytest
import tiny
import torch

from memmlp.deploy.export import export_module
from memmlp.deploy.parity import TOLERANCE, measure_largest_difference
from memmlp.motion.body import JOINTS

pytestmark = pytest.mark.slow

CLIP = tiny.clip(50)


def test_an_export_says_nothing_of_its_own_passes(tmp_path, caplog):
    class SameTwice(torch.nn.Module):
        """Two outputs are one constant, which the exporter's passes complain of."""

        def forward(self, x):
            return x, torch.ones(1, 40), torch.ones(1, 40)

    export_module(
        SameTwice(), (torch.zeros(1),), ["x"], ["y", "ones.next", "again.next"], tmp_path / "step.onnx", {}
    )
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []


def test_numbers_interface_and_metadata(naive_step):
    model, path = naive_step
    assert measure_largest_difference(model, path, CLIP) <= TOLERANCE
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
