"""CPU time and number of operations of a streaming step."""

import copy
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import onnx
import torch
import torch.nn.functional as F
from onnx import TensorProto, helper
from torch import Tensor
from torch.backends import mha
from torch.utils.flop_counter import FlopCounterMode, flop_registry, shape_wrapper

from memmlp.common.processes import CoreUsageTimer
from memmlp.deploy.onnx_stream import OnnxStream, start_session
from memmlp.motion.body import MOTION_DIM, N_JOINTS, POSITION, ROTATION, SPARSE_DIM
from memmlp.motion.normalizer import Change, Normalizer
from memmlp.networks.motion_model import MotionModel, StreamingGraph
from memmlp.networks.vqvae import EMACodebook

WARM_UP = 30  # number of untimed steps at the start
Model = TypeVar("Model", bound=MotionModel)
YARDSTICK_SHAPE = (41, 512, 8)  # rows, width, layers


def measure_step_times(path: Path, steps: int = 200) -> dict[str, Any]:
    """Time one step of an exported file on one thread: median and 95th percentile, in milliseconds, of at
    least 200 steps. Steps alternate with the yardstick, a fixed computation; the ratio of both times allows
    comparisons between machines. `core_share` is the fraction of the time in which the thread ran on a core.
    If it is far below 1, the times include waiting for other processes."""
    stream, reference = OnnxStream(path), start_session(make_yardstick().SerializeToString())
    sparse = np.zeros((1, SPARSE_DIM), np.float32)
    rows = {"input": np.ones(YARDSTICK_SHAPE[:2], np.float32)}
    ours, theirs = [], []
    for step in range(WARM_UP + max(steps, 200)):
        if step == WARM_UP:
            clock = CoreUsageTimer()
        start = time.perf_counter()
        stream.step(sparse)
        middle = time.perf_counter()
        reference.run(None, rows)
        if step >= WARM_UP:
            ours.append(middle - start)
            theirs.append(time.perf_counter() - middle)
    return {
        **summarize_times("", ours),
        **summarize_times("yardstick_", theirs),
        "ratio_to_yardstick": float(np.median(ours) / np.median(theirs)),
        "core_share": clock.fraction,
        "steps": len(ours),
        "threads": 1,
    }


def measure_size(model: MotionModel, step: MotionModel | StreamingGraph, path: Path) -> dict[str, Any]:
    """Return the number of parameters, MACs and FLOPs of a network, and the size of its file. `step` is the
    network or streaming graph that was exported.

    - "parameters": the parameters that training changes.
    - "parameters_with_vqvae": all parameters, including frozen parameters and code-vectors.
    - "macs", "flops": the operations of the network, as papers report them. Only matrix products are counted.
      A FLOP is one multiplication or addition; a MAC is one multiplication and one addition.
    - "step_macs": the operations of the exported graph.
    """
    macs = count_macs(model.cpu().eval())
    books = [part for part in model.modules() if isinstance(part, EMACodebook)]
    running_means = sum(book.vectors.numel() for book in books)  # learned, but not by gradients
    return {
        "parameters": model.count_parameters(),
        "parameters_with_vqvae": sum(p.numel() for p in model.parameters()) + running_means,
        "macs": macs,
        "flops": 2 * macs,
        "step_macs": count_macs(step.cpu().eval()),
        "onnx_bytes": path.stat().st_size,
    }


@torch.no_grad()
def count_macs(model: MotionModel | StreamingGraph) -> int:
    """Count the multiply-adds (MACs) in the matrix products of one streaming step."""
    counter = FlopCounterMode(display=False)
    counter.flop_registry = {**flop_registry, **CPU_FORMULAS}
    fast = mha.get_fastpath_enabled()
    mha.set_fastpath_enabled(False)  # it runs whole layers as one kernel, which hides their products
    try:
        with counter:
            model.advance(torch.zeros(1, 1, SPARSE_DIM), model.initial_state(1), 1)
    finally:
        mha.set_fastpath_enabled(fast)
    return counter.get_total_flops() // 2


def _count_lstm_flops(
    x: Sequence[int], to_gates: Sequence[int], again: Sequence[int], *shapes, **rest
) -> int:
    """Count the FLOPs of an LSTM, given the shapes of inputs (n, B, inputs), input weights (4 k, inputs) and
    hidden weights (4 k, k)."""
    return 2 * x[0] * x[1] * (to_gates[0] * to_gates[1] + again[0] * again[1])


aten = torch.ops.aten
CPU_FORMULAS = {  # of CPU kernels that torch counts as 0
    aten.mkldnn_rnn_layer: shape_wrapper(_count_lstm_flops),
    aten._scaled_dot_product_flash_attention_for_cpu: flop_registry[aten._scaled_dot_product_flash_attention],
}


def make_yardstick() -> onnx.ModelProto:
    """Make the yardstick: a fixed reference network of matrix products and ReLUs, in 86 M multiply-adds."""
    rows, width, layers = YARDSTICK_SHAPE
    weight = np.random.default_rng(0).standard_normal((width, width), np.float32) / np.sqrt(width)
    nodes, name = [], "input"
    for layer in range(layers):
        nodes.append(helper.make_node("MatMul", [name, "weight"], [f"product{layer}"]))
        nodes.append(helper.make_node("Relu", [f"product{layer}"], [f"hidden{layer}"]))
        name = f"hidden{layer}"
    value = helper.make_tensor_value_info
    graph = helper.make_graph(
        nodes,
        "yardstick",
        [value("input", TensorProto.FLOAT, [rows, width])],
        [value(name, TensorProto.FLOAT, [rows, width])],
        [onnx.numpy_helper.from_array(weight.astype(np.float32), "weight")],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)


def summarize_times(prefix: str, seconds: Sequence[float] | np.ndarray) -> dict[str, float]:
    return {
        f"{prefix}median_ms": 1000 * float(np.median(seconds)),
        f"{prefix}p95_ms": 1000 * float(np.percentile(seconds, 95)),
    }


class NoConversion(Normalizer):
    """A normalizer that converts nothing: inputs and outputs stay in network space. Joint positions are
    zeros."""

    def encode_sparse(self, sparse: Tensor, origin: Tensor) -> Tensor:
        return sparse

    def encode_motion(self, motion: Tensor, origin: Tensor) -> Tensor:
        return motion

    def decode_motion(self, motion: Tensor, origin: Tensor) -> Tensor:
        return motion

    def convert_rotations_to_world(self, rotations: Tensor, origin: Tensor) -> Tensor:
        return rotations

    def decode_rotations(self, rotation: Tensor, sparse: Tensor) -> Tensor:
        return F.pad(rotation, (0, MOTION_DIM - ROTATION.stop))

    def build_world_motion(self, rotations: Tensor, sparse: Tensor, change: Change | None = None) -> Tensor:
        return self.decode_rotations(rotations, sparse)

    def compute_positions(self, motion: Tensor, sparse: Tensor) -> Tensor:
        return torch.zeros_like(motion[..., POSITION]).unflatten(-1, (N_JOINTS, 3))


def strip_conversions(model: Model) -> Model:
    """Copy a network, and remove its input and output conversions and its forward kinematics. Papers time a
    network in this way: from its features to its outputs. Joint computations between layers (AvatarJLM's
    tokens, MANIKIN's limbs) stay. The copy is only valid for timing."""
    stripped = copy.deepcopy(model)
    for module in list(stripped.modules()):
        for name, child in module.named_children():
            if isinstance(child, Normalizer):
                setattr(module, name, NoConversion(child.coordinates, child.rest, child.mean, child.std))
    return stripped
