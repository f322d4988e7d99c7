"""Lower precision of an exported stream (int8, fp16), and its loss of accuracy.

Only the inner layers of a network change. The first and last modules stay in float32
(`StreamingGraph.float32_modules`). The input of the stem has outliers, and rounding in the heads would cause
jitter. Nearly all other jitter of int8 comes from rounding the newest frame, which `int16_modules` correct.
"""

import logging
import shutil
import tempfile
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import ModelProto, NodeProto, TensorProto, helper
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
from torch import Tensor

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write, naming_file
from memmlp.common.lease import publish_at_end
from memmlp.common.progress import progress_bar
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.deploy.opsets import GraphConstants
from memmlp.deploy.parity import stream_onnx
from memmlp.evaluation.metric_facts import MIN_FRAMES
from memmlp.evaluation.metrics import measure_positions
from memmlp.evaluation.modes import average_clips, extract_positions, measure_rotation_branch
from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.motion_model import StreamingGraph
from memmlp.runs.deployment_folder import is_accurate_enough

CALIBRATION_CLIPS, CALIBRATION_FRAMES, CALIBRATION_EVERY = 40, 400, 20
TEST_FRAMES = 20_000  # number of frames for measuring accuracy
LAST = np.iinfo(np.int64).max  # the end of a slice that includes the last row
LARGEST = float(np.finfo(np.float16).max)


def write_lower_precision(
    precision: str, source: Path, path: Path, network: StreamingGraph, train: Sequence[Tensor]
) -> None:
    """Write an ONNX file with lower precision, "int8" or "fp16", from the float32 file of a streaming graph.
    Its `float32_modules` stay in float32. Training clips (N, 252) calibrate int8. Raises InputError if the
    graph does not have inner layers, or a weight is out of range for fp16."""
    model = onnx.load(source)
    inner = find_inner_layers(model, network.float32_modules)
    if precision == "int8":
        _quantise_to_int8(source, path, inner, _list_prefixes(network.int16_modules), train)
    else:
        atomic_write(path, convert_to_fp16(model, inner).SerializeToString())


def find_inner_layers(model: ModelProto, kept: Sequence[str]) -> list[str]:
    """Return the names of the nodes that multiply by a layer's weight, outside of the kept modules. Raises
    InputError if there are none: ONNX Runtime would quantise all nodes for an empty list."""
    weights = {tensor.name for tensor in model.graph.initializer}
    inner = [
        node.name
        for node in model.graph.node
        if node.op_type in ("Gemm", "MatMul")
        and node.input[1] in weights
        and node.input[1].startswith("model.")
        and not node.input[1].startswith(_list_prefixes(kept))
    ]
    if not inner:
        raise InputError("export.precision: must be fp32; this network does not have inner layers")
    return inner


def _list_prefixes(modules: Sequence[str]) -> tuple[str, ...]:
    return tuple(f"model.{name}." for name in modules)


class ActivationSamples(CalibrationDataReader):
    """Calibration samples: the inputs and states at every twentieth frame of streamed clips (N, 252). At most
    40 clips are streamed, and the middle 400 frames of each clip."""

    def __init__(self, path: Path, clips: Sequence[Tensor]):
        self.samples = _stream_samples(OnnxStream(path), clips[:CALIBRATION_CLIPS])

    def get_next(self) -> dict[str, np.ndarray] | None:  # type: ignore[override]
        """Return the next sample, or None at the end."""
        return next(self.samples, None)  # type: ignore[arg-type]


def _stream_samples(stream: OnnxStream, clips: Sequence[Tensor]) -> Iterator[dict[str, np.ndarray]]:
    for clip in clips:
        stream.reset()
        start = max(len(clip) - CALIBRATION_FRAMES, 0) // 2
        middle = clip[start : start + CALIBRATION_FRAMES, None, :SPARSE_DIM]
        for index, sparse in enumerate(middle.numpy(), start=1):
            if index % CALIBRATION_EVERY == 0:
                yield {"sparse": sparse, **stream.state}
            stream.step(sparse)


def _quantise_to_int8(
    source: Path, path: Path, inner: list[str], corrected: tuple[str, ...], clips: Sequence[Tensor]
) -> None:
    """Write an int8 file by ONNX Runtime's static quantisation. `corrected` are prefixes of weights. Weights
    have seven bits and one scale per output, or one scale if they join several layers (ONNX Runtime has no
    such product with more scales). CPUs without VNNI add products in sixteen bits, and would overflow with
    eight-bit weights. Activations have eight bits and one scale, calibrated on streamed clips."""
    joined = [tensor.name for tensor in onnx.load(source).graph.initializer if len(tensor.dims) == 3]
    root = logging.getLogger()
    level = root.level
    root.setLevel(logging.ERROR)  # hide the advice to prepare the graph; torch's exporter did it already
    try:
        with publish_at_end(path) as unfinished, naming_file(path), tempfile.TemporaryDirectory() as folder:
            quantize_static(
                shutil.copy(source, folder),  # it writes another file beside its source
                unfinished,
                ActivationSamples(source, clips),
                quant_format=QuantFormat.QDQ,
                nodes_to_quantize=inner,
                op_types_to_quantize=["Gemm", "MatMul"],
                per_channel=True,
                reduce_range=True,  # seven bits
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
                extra_options={
                    "OpTypesToExcludeOutputQuantization": ["Gemm", "MatMul"],
                    "TensorQuantOverrides": {
                        name: [{"quant_type": QuantType.QInt8, "reduce_range": True}] for name in joined
                    },
                },
            )
            model = onnx.load(unfinished)
            _check_quantised(model, inner)
            _correct_newest_frames(model, inner, corrected)
            onnx.save(model, unfinished)
    finally:
        root.setLevel(level)


def _check_quantised(model: ModelProto, inner: Collection[str]) -> None:
    """Raise RuntimeError if a layer kept its weight in float32; ONNX Runtime may skip layers silently."""
    scaled = (node for node in model.graph.node if node.op_type == "DequantizeLinear")
    quantised = {name for node in scaled for name in node.output}
    layers = {node.name: node.input[1] for node in model.graph.node if node.name in inner}
    if skipped := [name for name in inner if layers.get(name) not in quantised]:
        count = f"{len(skipped)} of {len(inner)} layers"
        raise RuntimeError(f"ONNX Runtime left {count} in float32, such as {skipped[0]}")


def _correct_newest_frames(model: ModelProto, inner: Collection[str], corrected: tuple[str, ...]) -> None:
    """Add to each corrected layer the product of its weight and the rounding error of its input's last row.
    The error is at most half a step of eight bits. It has eight more bits, so the row has sixteen. Opset 15
    cannot add to a row, so its files are not corrected."""
    if model.opset_import[0].version < 16:
        return
    constants, nodes = GraphConstants(model.graph), list[NodeProto]()
    makers = {name: node for node in model.graph.node for name in node.output}
    last = [constants.add(f"last_row.{value}", np.array([value])) for value in (-1, LAST, 0)]
    row = constants.add("last_row", np.array([[-1]]))
    middle = constants.add("middle", np.array(128, np.uint8))
    for node in model.graph.node:
        nodes.append(node)
        if node.name not in inner or not node.input[1].startswith(corrected):
            continue
        (rounded, weight), output = node.input[:2], node.output[0]
        exact, scale, _ = makers[makers[rounded].input[0]].input
        step = constants.add(f"{scale}.error", (constants.get_value(scale) / 255).astype(np.float32))
        node.output[0] = f"{output}.rounded"
        for kind, name, inputs in (
            ("Slice", "exact_row", [exact, *last]),
            ("Slice", "rounded_row", [rounded, *last]),
            ("Sub", "error", [f"{output}.exact_row", f"{output}.rounded_row"]),
            ("QuantizeLinear", "bits", [f"{output}.error", step, middle]),
            ("DequantizeLinear", "value", [f"{output}.bits", step, middle]),
            (node.op_type, "product", [f"{output}.value", weight]),
        ):
            nodes.append(helper.make_node(kind, inputs, [f"{output}.{name}"], f"{output}.{name}"))
        nodes[-1].attribute.extend(node.attribute)
        inputs = [node.output[0], row, f"{output}.product"]
        nodes.append(helper.make_node("ScatterND", inputs, [output], output, reduction="add"))
    constants.replace_nodes(nodes)


def convert_to_fp16(model: ModelProto, inner: Sequence[str]) -> ModelProto:
    """Return the graph with the weights and products of the inner layers in fp16. This halves the file size.
    The inputs and outputs of these products are fp16, like under autocast. Sums, normalisations, inputs,
    outputs and states stay float32, because fp16 resolves a world position of 4 m only to 4 mm. ONNX
    Runtime's own converter would also round these values."""
    constants, nodes, halves = GraphConstants(model.graph), list[NodeProto](), dict[str, str]()
    for node in model.graph.node:
        if node.name not in inner:
            nodes.append(node)
            continue
        for index, name in enumerate(node.input):
            if name in constants:
                weight = constants.get_value(name)
                if not np.abs(weight).max() <= LARGEST:
                    reason = f"{name} has weights above {LARGEST:.0f}"
                    raise InputError(f"export.precision=fp16: must be fp32; {reason}")
                node.input[index] = constants.add(f"{name}.half", weight.astype(np.float16))
            else:
                if name not in halves:
                    halves[name] = f"{name}.half"
                    nodes.append(_make_cast_node(name, halves[name], TensorProto.FLOAT16))
                node.input[index] = halves[name]
        output = node.output[0]
        node.output[0] = f"{output}.made"
        nodes += [node, _make_cast_node(node.output[0], output, TensorProto.FLOAT)]
    constants.replace_nodes(nodes)
    del model.graph.value_info[:]
    return model


def _make_cast_node(name: str, output: str, kind: int) -> NodeProto:
    return helper.make_node("Cast", [name], [output], f"{output}.cast", to=kind)


def measure_accuracy(path: Path, normalizer: Normalizer, clips: Sequence[Tensor]) -> dict[str, float]:
    """Stream clips (N, 252) in ONNX Runtime, and return the mean metrics of the rotation branch. "position
    MPJPE" is the MPJPE of the file's output `position`. If the clips have more than 20,000 frames, the same
    fraction of each clip is streamed, from its start, but enough for every metric. Clips that are too short
    for a metric do not count (`average_clips`)."""
    stream, share = OnnxStream(path), min(1.0, TEST_FRAMES / sum(map(len, clips)))
    rows, frames = [], []
    for clip in progress_bar(clips, "measuring"):
        truth = clip[: max(int(share * len(clip)), max(MIN_FRAMES.values()))]
        motion = stream_onnx(stream, truth)
        positions = extract_positions(motion), extract_positions(truth[:, SPARSE_DIM:])
        position = measure_positions(*positions)["MPJPE"]
        errors = measure_rotation_branch(normalizer, motion, truth) | {"position MPJPE": position}
        rows.append({"rotation": errors})
        frames.append(len(truth))
    return average_clips(rows, frames)["rotation"]


def compare_accuracy(
    exact: Path, other: Path, precision: str, normalizer: Normalizer, clips: Sequence[Tensor]
) -> dict[str, Any]:
    """Measure the loss of accuracy from lower precision on test clips (N, 252). `exact` is the float32 file,
    `other` that of the same network in the given precision, such as "int8". Return the metrics of both files;
    the relative growth of MPJPE, for the branch with the larger growth, and of Jitter; and whether the file
    in lower precision may be the default (`is_accurate_enough`)."""
    before, after = (measure_accuracy(path, normalizer, clips) for path in (exact, other))
    names = "MPJPE", "position MPJPE", "Jitter"
    rotation, position, jitter = (after[name] / before[name] - 1 for name in names)
    grown = {"growth": float(np.maximum(rotation, position)), "jitter_growth": jitter}  # NaN if either is
    return {"fp32": before, precision: after, **grown, "default": is_accurate_enough(grown)}
