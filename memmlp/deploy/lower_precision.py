"""Lower precision of an exported stream: int8, int8 in blocks, fp16; and what that costs in accuracy.

Only a network's inner layers change. The modules at its ends stay in float32, as the graph says
(`StreamingGraph.float32_modules`): the stem's input has outliers, and rounding in the heads would show as
jitter.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import ModelProto, NodeProto, TensorProto, helper
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
from torch import Tensor

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write
from memmlp.common.lease import publish, temporary_path
from memmlp.common.progress import progress_bar
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.deploy.opsets import Constants
from memmlp.deploy.parity import stream_onnx
from memmlp.evaluation.metrics import positions_report
from memmlp.evaluation.modes import joint_positions, rotations_report
from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.motion_model import StreamingGraph
from memmlp.runs.deployment_folder import is_accurate_enough

CALIBRATION_CLIPS, CALIBRATION_FRAMES, CALIBRATION_EVERY = 40, 400, 20
TEST_FRAMES = 20_000  # accuracy is measured on at most this many
LARGEST = float(np.finfo(np.float16).max)
BLOCK = 32  # inputs of a product that share a scale; the least that all of ONNX Runtime's kernels know
LEVELS, ZERO = 127, 128  # a weight w is stored as the byte 128 + 127 w / (largest of its block)
DOMAIN = "com.microsoft"
INTEGER_ACCURACY = 4  # the accuracy level at which MatMulNBits multiplies integers


def lower(precision: str, source: Path, path: Path, network: StreamingGraph, train: Sequence[Tensor]) -> None:
    """Write a file with lower precision.

    Args:
        precision: "int8", "int8_blocks" or "fp16".
        source: the float32 ONNX file of a streaming graph.
        path: the file to write.
        network: the graph, which says which of its modules stay in float32.
        train: training clips (N, 252), to calibrate int8.

    Raises:
        InputError: for a graph without inner layers, or a weight that sixteen bits cannot hold.
    """
    model = onnx.load(source)
    inner = find_inner_layers(model, network.float32_modules)
    if precision == "int8":
        _quantise(source, path, inner, train)
    else:
        change = store_in_blocks if precision == "int8_blocks" else halve
        atomic_write(path, change(model, inner).SerializeToString())


def find_inner_layers(model: ModelProto, kept: Sequence[str]) -> list[str]:
    """Return the names of the nodes that multiply by a layer's weight, except those in the kept modules.

    Raises:
        InputError: if there are no such nodes. The file would be the float32 one by another name, and ONNX
            Runtime takes all nodes where it gets no names.
    """
    weights = {tensor.name for tensor in model.graph.initializer}
    beginnings = tuple(f"model.{name}." for name in kept)
    inner = [
        node.name
        for node in model.graph.node
        if node.op_type in ("Gemm", "MatMul")
        and node.input[1] in weights
        and node.input[1].startswith("model.")
        and not node.input[1].startswith(beginnings)
    ]
    if not inner:
        raise InputError("export.precision: must be fp32; no layer lies between this network's ends")
    return inner


class ActivationSamples(CalibrationDataReader):
    """Calibration samples, which are inputs and states: every twentieth frame of streams of clips (N, 252).

    The middle 400 frames of each clip are streamed.
    """

    def __init__(self, path: Path, clips: Sequence[Tensor]):
        self.samples = self._stream(OnnxStream(path), clips[:CALIBRATION_CLIPS])

    def get_next(self) -> dict[str, np.ndarray] | None:  # type: ignore[override]
        """Return the next sample, or None at the end."""
        return next(self.samples, None)  # type: ignore[arg-type]

    @staticmethod
    def _stream(stream: OnnxStream, clips: Sequence[Tensor]) -> Iterator[dict[str, np.ndarray]]:
        for clip in clips:
            stream.reset()
            start = max(len(clip) - CALIBRATION_FRAMES, 0) // 2
            middle = clip[start : start + CALIBRATION_FRAMES, None, :SPARSE_DIM]
            for index, sparse in enumerate(middle.numpy()):
                if index % CALIBRATION_EVERY == CALIBRATION_EVERY - 1:
                    yield {"sparse": sparse, **stream.state}
                stream.step(sparse)


def _quantise(source: Path, path: Path, inner: list[str], clips: Sequence[Tensor]) -> None:
    """Write int8 by ONNX Runtime's static quantisation.

    Weights get one scale for each output, and seven bits: with eight bits, CPUs without VNNI overflow, since
    they add products in sixteen bits. Activations get eight bits and one scale, found by streaming clips.
    """
    unfinished, root = temporary_path(path), logging.getLogger()
    level = root.level
    root.setLevel(logging.ERROR)  # it advises to prepare the graph, which torch's exporter has done already
    try:
        quantize_static(
            source,
            unfinished,
            ActivationSamples(source, clips),
            quant_format=QuantFormat.QDQ,
            nodes_to_quantize=inner,
            op_types_to_quantize=["Gemm", "MatMul"],
            per_channel=True,
            reduce_range=True,  # seven bits
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            extra_options={"OpTypesToExcludeOutputQuantization": ["Gemm", "MatMul"]},
        )
        publish(unfinished, path)
    finally:
        root.setLevel(level)
        unfinished.unlink(missing_ok=True)


def store_in_blocks(model: ModelProto, inner: Sequence[str]) -> ModelProto:
    """Return the graph with 8-bit weights that have a scale for every 32 inputs of an output.

    A product's inputs are rounded to eight bits while it is computed, with a scale for every 32 of them
    (`MatMulNBits`, ONNX Runtime's own operator). So there is no calibration, and a layer is one operation
    instead of four. It suits networks without a window, whose products have one row; products with a window's
    rows are slower than in float32.
    """
    constants, nodes = Constants(model.graph), list[NodeProto]()
    for node in model.graph.node:
        if node.name not in inner:
            nodes.append(node)
            continue
        values, name, *bias = node.input
        weight = constants.value(name)
        if not any(one.name == "transB" and one.i for one in node.attribute):
            weight = weight.T
        codes, scales = blocks(weight)
        stored = constants.add(f"{name}.blocks", codes), constants.add(f"{name}.scales", scales.reshape(-1))
        product = helper.make_node(
            "MatMulNBits",
            [values, *stored, *(["", "", *bias] if bias else [])],
            list(node.output),
            node.name,
            domain=DOMAIN,
            N=weight.shape[0],
            K=weight.shape[1],
            bits=8,
            block_size=BLOCK,
            accuracy_level=INTEGER_ACCURACY,
        )
        nodes.append(product)
    constants.replace_nodes(nodes)
    if all(one.domain != DOMAIN for one in model.opset_import):
        model.opset_import.append(helper.make_opsetid(DOMAIN, 1))
    return model


def blocks(weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a weight (outputs, inputs) as bytes (outputs, blocks, 32) and scales (outputs, blocks).

    The last block is padded with zeros.
    """
    outputs, inputs = weight.shape
    padded = np.pad(weight, ((0, 0), (0, -inputs % BLOCK))).reshape(outputs, -1, BLOCK)
    scales = np.abs(padded).max(-1) / LEVELS
    steps = np.divide(padded, scales[..., None], where=scales[..., None] > 0, out=np.zeros_like(padded))
    return (np.rint(steps) + ZERO).astype(np.uint8), scales.astype(np.float32)


def halve(model: ModelProto, inner: Sequence[str]) -> ModelProto:
    """Return the graph with the inner layers' weights and products in fp16, which halves the file's size.

    As under autocast, these products have 16-bit inputs and outputs, and everything between them stays
    float32: sums, normalisations, inputs, outputs and states. A world position of 4 m has a resolution of
    4 mm in sixteen bits. ONNX Runtime's converter would round every value between two nodes that stay
    float32.
    """
    constants, nodes, halves = Constants(model.graph), list[NodeProto](), dict[str, str]()
    for node in model.graph.node:
        if node.name not in inner:
            nodes.append(node)
            continue
        for index, name in enumerate(node.input):
            if name in constants:
                weight = constants.value(name)
                if not np.abs(weight).max() <= LARGEST:
                    raise InputError(f"{name}: has weights beyond {LARGEST:.0f}; use export.precision=fp32")
                node.input[index] = constants.add(f"{name}.half", weight.astype(np.float16))
            else:
                if name not in halves:
                    halves[name] = f"{name}.half"
                    nodes.append(_cast(name, halves[name], TensorProto.FLOAT16))
                node.input[index] = halves[name]
        output = node.output[0]
        node.output[0] = f"{output}.made"
        nodes += [node, _cast(node.output[0], output, TensorProto.FLOAT)]
    constants.replace_nodes(nodes)
    del model.graph.value_info[:]
    return model


def _cast(name: str, output: str, kind: int) -> NodeProto:
    return helper.make_node("Cast", [name], [output], f"{output}.cast", to=kind)


def measure_accuracy(path: Path, normalizer: Normalizer, clips: Sequence[Tensor]) -> dict[str, float]:
    """Measure the rotation branch's metrics, streamed in ONNX Runtime: means over clips (N, 252).

    "position MPJPE" is that of the file's positions: of the position branch, where the network has one.
    At most 20,000 frames are streamed; if there are more, the first part of each clip is, with the same share
    of all clips.
    """
    stream, share = OnnxStream(path), min(1.0, TEST_FRAMES / sum(map(len, clips)))
    rows = []
    for clip in progress_bar(clips, "measuring"):
        truth = clip[: max(int(share * len(clip)), 2)]
        motion = stream_onnx(stream, truth)
        positions = joint_positions(motion), joint_positions(truth[:, SPARSE_DIM:])
        position = positions_report(*positions)["MPJPE"]
        rows.append(rotations_report(normalizer, motion, truth) | {"position MPJPE": position})
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def compare_accuracy(
    exact: Path, other: Path, precision: str, normalizer: Normalizer, clips: Sequence[Tensor]
) -> dict[str, Any]:
    """Measure on test clips what lower precision costs in accuracy.

    Args:
        exact: the float32 file.
        other: the same network with lower precision.
        precision: name of the lower precision, such as "int8".
        normalizer: the network's normalizer.
        clips: frames (N, 252) of each clip.

    Returns:
        The metrics of both files, the relative growth of MPJPE, of the branch in which that is larger, and of
        Jitter, and whether the other file may be the default (`is_accurate_enough`).
    """
    before, after = (measure_accuracy(path, normalizer, clips) for path in (exact, other))
    growths = {name: after[name] / before[name] - 1 for name in ("MPJPE", "position MPJPE", "Jitter")}
    jitter = growths.pop("Jitter")
    grown = {"growth": float(np.max(list(growths.values()))), "jitter_growth": jitter}  # NaN if either is
    return {"fp32": before, precision: after, **grown, "default": is_accurate_enough(grown)}
