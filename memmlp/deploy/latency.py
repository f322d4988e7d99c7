"""The time of a streaming step on a CPU, and its number of operations."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

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

WARM_UP = 30  # steps before the timed ones
SETTLING = 3  # untimed steps of a file at the start of each round
Key = TypeVar("Key", bound=Hashable)
Model = TypeVar("Model", bound=MotionModel)
YARDSTICK_SHAPE = (41, 512, 8)  # rows, width, layers: 86 M multiply-adds of plain matrix products


class InTurn(NamedTuple):
    """Times of one file that was timed in turn with others.

    Attributes:
        seconds: the time of each step (rounds, steps), in seconds.
        core_shares: the share of each round (rounds,) in which the thread had a core.
    """

    seconds: np.ndarray
    core_shares: np.ndarray


def measure_step(path: Path, steps: int = 200) -> dict[str, Any]:
    """Time one step of an exported file on one thread: median and 95th percentile, in milliseconds.

    The step is timed in alternation with the yardstick, a fixed computation, so that their ratio compares
    machines. At least 200 steps are timed, however few are asked for. `core_share` is the share of that time
    in which the thread had a core: if it is far less than 1, these times include waiting for other processes.
    """
    stream, reference = OnnxStream(path), start_session(yardstick().SerializeToString())
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
        **_milliseconds("", ours),
        **_milliseconds("yardstick_", theirs),
        "ratio_to_yardstick": float(np.median(ours) / np.median(theirs)),
        "core_share": clock.fraction,
        "steps": len(ours),
        "threads": 1,
    }


def time_in_turn(paths: Mapping[Key, Path], rounds: int, steps: int) -> dict[Key, InTurn]:
    """Time the steps of exported files on one thread, with all files in turn in each round.

    A file's first steps in each round, in which the caches fill, are not counted.
    """
    streams = {key: OnnxStream(path) for key, path in paths.items()}
    random = np.random.default_rng(0)
    given = {
        key: [np.asarray(random.normal(size=array.shape), np.float32) for array in stream.inputs.values()]
        for key, stream in streams.items()
    }

    def time_round(key: Key) -> np.ndarray:
        seconds = np.zeros(SETTLING + steps)
        for step in range(len(seconds)):
            start = time.perf_counter()
            streams[key].step(*given[key])
            seconds[step] = time.perf_counter() - start
        return seconds[SETTLING:]

    return in_turn(paths, rounds, time_round)


def in_turn(keys: Iterable[Key], rounds: int, time_round: Callable[[Key], np.ndarray]) -> dict[Key, InTurn]:
    """Time files in rounds, all in turn in each, in an order that is reversed after each round.

    Args:
        keys: the files' keys.
        rounds: how many rounds.
        time_round: times a file's steps of one round, and returns their seconds (steps,).
    """
    order = list(keys)
    seconds: dict[Key, list[np.ndarray]] = {key: [] for key in order}
    shares: dict[Key, list[float]] = {key: [] for key in order}
    for _ in range(rounds):
        for key in order:
            clock = CoreUsageTimer()
            seconds[key].append(time_round(key))
            shares[key].append(clock.fraction)
        order.reverse()
    return {key: InTurn(np.array(seconds[key]), np.array(shares[key])) for key in seconds}


def size(model: MotionModel, step: MotionModel | StreamingGraph, path: Path) -> dict[str, Any]:
    """Measure a network: its parameters, MACs and FLOPs, the MACs of its exported step, the file's bytes.

    "parameters" are those that training changes; "parameters_with_vqvae" are all, with frozen ones and
    code-vectors. "macs" and "flops" are the network's, which papers count; "step_macs" are those of the
    exported graph. Only matrix products are counted; a FLOP is one multiplication or addition, a MAC is one
    of each.

    Args:
        model: the network as it was trained.
        step: the network or streaming graph that was exported.
        path: the exported file.
    """
    multiplied = count_macs(model.cpu().eval())
    books = [part for part in model.modules() if isinstance(part, EMACodebook)]
    running_means = sum(book.vectors.numel() for book in books)  # learned, but not by gradients
    return {
        "parameters": model.count_parameters(),
        "parameters_with_vqvae": sum(p.numel() for p in model.parameters()) + running_means,
        "macs": multiplied,
        "flops": 2 * multiplied,
        "step_macs": count_macs(step.cpu().eval()),
        "onnx_bytes": path.stat().st_size,
    }


@torch.no_grad()
def count_macs(model: MotionModel | StreamingGraph) -> int:
    """Count the multiply-adds of the matrix products of one streaming step."""
    counter = FlopCounterMode(display=False)
    counter.flop_registry = {**flop_registry, **CPU_FORMULAS}
    fast = mha.get_fastpath_enabled()
    mha.set_fastpath_enabled(False)  # whole layers as one kernel, without its products
    try:
        with counter:
            model.advance(torch.zeros(1, 1, SPARSE_DIM), model.initial_state(1), 1)
    finally:
        mha.set_fastpath_enabled(fast)
    return counter.get_total_flops() // 2


def _lstm_flops(x: Sequence[int], to_gates: Sequence[int], again: Sequence[int], *shapes, **rest) -> int:
    """Count an LSTM's FLOPs from its arguments' shapes.

    These are inputs (n, B, inputs), their weights (4 k, inputs), and the hidden state's weights (4 k, k).
    """
    return 2 * x[0] * x[1] * (to_gates[0] * to_gates[1] + again[0] * again[1])


CPU_FORMULAS = {
    torch.ops.aten.mkldnn_rnn_layer: shape_wrapper(_lstm_flops),
    torch.ops.aten._scaled_dot_product_flash_attention_for_cpu: flop_registry[
        torch.ops.aten._scaled_dot_product_flash_attention
    ],
}
"""Formulas of CPU kernels that torch's own counter counts as 0."""


def yardstick() -> onnx.ModelProto:
    """Make the yardstick, a fixed reference network of matrix products and ReLUs."""
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


def _milliseconds(prefix: str, seconds: list[float]) -> dict[str, float]:
    """Return median and 95th percentile of seconds, in milliseconds, with the prefix before their keys."""
    return {
        f"{prefix}median_ms": 1000 * float(np.median(seconds)),
        f"{prefix}p95_ms": 1000 * float(np.percentile(seconds, 95)),
    }


class NoConversion(Normalizer):
    """A normalizer that changes nothing: inputs are features already, outputs stay in network space.

    Joint positions are zeros.
    """

    def encode_sparse(self, sparse: Tensor, origin: Tensor) -> Tensor:
        return sparse

    def encode_motion(self, motion: Tensor, origin: Tensor) -> Tensor:
        return motion

    def decode_motion(self, motion: Tensor, origin: Tensor) -> Tensor:
        return motion

    def rotations_out(self, rotations: Tensor, origin: Tensor) -> Tensor:
        return rotations

    def posed(self, rotation: Tensor, sparse: Tensor) -> Tensor:
        return F.pad(rotation, (0, MOTION_DIM - ROTATION.stop))

    def posed_in_world(self, rotations: Tensor, sparse: Tensor, change: Change | None = None) -> Tensor:
        return self.posed(rotations, sparse)

    def pose(self, motion: Tensor, sparse: Tensor) -> Tensor:
        return torch.zeros_like(motion[..., POSITION]).unflatten(-1, (N_JOINTS, 3))


def strip_conversions(model: Model) -> Model:
    """Copy a network without the conversions before and after it and without its forward kinematics.

    Papers time this: from features to the network's own outputs. Computations with joints between the
    network's layers (AvatarJLM's tokens, MANIKIN's limbs) stay. The copy is only good for timing.
    """
    made = copy.deepcopy(model)
    for module in list(made.modules()):
        for name, child in module.named_children():
            if isinstance(child, Normalizer):
                setattr(module, name, NoConversion(child.coordinates, child.rest, child.mean, child.std))
    return made
