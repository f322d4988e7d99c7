"""A graph that was kept is the one that the exporter makes of another module of the same structure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnx_ir
import pytest
import torch
from kept_exports import Kept, kept
from torch import Tensor, nn


class Foreign(nn.Module):
    """Code that is neither memmlp's nor torch's."""

    def forward(self, x: Tensor) -> Tensor:
        return 2 * x


def tensors(graph: onnx.ModelProto) -> dict[str, np.ndarray]:
    return {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.graph.initializer}


@pytest.fixture
def export(tmp_path: Path):
    """Export a module; returns its graph and how often an exporter was asked until now.

    It stands in for torch's: whether graphs with other weights compute what torch does, each test of parity
    with ONNX Runtime tells.
    """
    calls = []

    def exporter(module: nn.Module, *arguments: object, **options: object) -> Kept:
        calls.append(arguments)
        weights = [onnx.numpy_helper.from_array(w.numpy(), n) for n, w in module.state_dict().items()]
        graph = onnx.helper.make_graph([], "stand-in", [], [], weights)
        return Kept(onnx_ir.serde.deserialize_model(onnx.helper.make_model(graph)))

    def exported(module: nn.Module, opset: int = 18) -> tuple[onnx.ModelProto, int]:
        program = kept(exporter, tmp_path)(module.eval(), (torch.zeros(1, 3),), opset_version=opset)
        return program.model_proto, len(calls)

    return exported


def test_weights_are_each_modules_own_and_all_else_makes_another_graph(export):
    first, second, epsilon = (nn.Sequential(nn.Linear(3, 4), nn.LayerNorm(4, eps)) for eps in (1, 1, 2))
    for module in (first, second, epsilon):
        nn.init.normal_(module[1].weight)
    (graph, one), (again, two) = export(first), export(second)
    assert (one, two) == (1, 1)
    for found, module in ((graph, first), (again, second)):
        for name, weight in module.state_dict().items():
            np.testing.assert_array_equal(tensors(found)[name], weight)
    assert export(epsilon)[1] == 2
    assert export(first, opset=19)[1] == 3
    assert export(nn.Sequential(nn.Linear(3, 4), first[1]).requires_grad_(False))[1] == 4
    assert export(nn.Sequential(first, Foreign()))[1] == export(nn.Sequential(first, Foreign()))[1] - 1 == 5
    assert export(second)[1] == 6


def test_a_set_is_the_same_in_whatever_order(export):
    orders = frozenset([0, 8]), frozenset([8, 0])  # as two processes have the same set of words
    assert list(orders[0]) != list(orders[1])
    for order in orders:
        module = nn.Sequential(nn.Linear(3, 4))
        module.chosen = order
        assert export(module)[1] == 1
    module.chosen = frozenset([8])
    assert export(module)[1] == 2
