"""int8 of an exported stream, by ONNX Runtime's static quantisation.

Weights get one scale for each output, and seven bits: with eight bits, CPUs without VNNI overflow, since they
add products in sixteen bits. Activations get eight bits and one scale, found by streaming training clips
through the network. The modules at the network's ends stay in float32, as the graph says
(`StreamingGraph.float32_modules`): the stem's input has outliers, and rounding in the heads would show as
jitter.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import onnx
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
from torch import Tensor

from memmlp.common.errors import InputError
from memmlp.common.lease import publish, temporary
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.motion.body import SPARSE_DIM

CALIBRATION_CLIPS, CALIBRATION_FRAMES, CALIBRATION_EVERY = 40, 400, 20


class ActivationSamples(CalibrationDataReader):
    """Calibration samples, which are inputs and states: every twentieth frame of streams of clips (N, 252).

    The middle 400 frames of each clip are streamed.
    """

    def __init__(self, path: Path, clips: Sequence[Tensor]):
        self.samples = _samples(OnnxStream(path), clips[:CALIBRATION_CLIPS])

    def get_next(self) -> dict[str, np.ndarray] | None:  # type: ignore[override]
        """Return the next sample, or None at the end."""
        return next(self.samples, None)  # type: ignore[arg-type]


def _samples(stream: OnnxStream, clips: Sequence[Tensor]) -> Iterator[dict[str, np.ndarray]]:
    for clip in clips:
        stream.reset()
        start = max(len(clip) - CALIBRATION_FRAMES, 0) // 2
        for index, sparse in enumerate(clip[start : start + CALIBRATION_FRAMES, None, :SPARSE_DIM].numpy()):
            if index % CALIBRATION_EVERY == CALIBRATION_EVERY - 1:
                yield {"sparse": sparse, **stream.state}
            stream.step(sparse)


def quantise(source: Path, path: Path, kept: Sequence[str], clips: Sequence[Tensor]) -> None:
    """Write the int8 form of an exported stream.

    Args:
        source: the float32 ONNX file of a streaming graph.
        path: the file to write.
        kept: names of the graph's modules that stay in float32.
        clips: training clips (N, 252), from which the activations' ranges are found.

    Raises:
        InputError: for a graph without inner layers.
    """
    inner = inner_layers(onnx.load(source), kept)
    unfinished, quiet = temporary(path), logging.getLogger()
    level = quiet.level
    quiet.setLevel(logging.ERROR)  # it advises to prepare the graph, which torch's exporter has done already
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
        quiet.setLevel(level)
        unfinished.unlink(missing_ok=True)


def inner_layers(graph: onnx.ModelProto, kept: Sequence[str]) -> list[str]:
    """Return the names of the nodes that multiply by a layer's weight, except those in the kept modules.

    Raises:
        InputError: if there is none. A file in a lower precision would be the float32 one by another name,
            and where ONNX Runtime is told no names, it takes all nodes.
    """
    weights = {tensor.name for tensor in graph.graph.initializer}
    beginnings = tuple(f"model.{name}." for name in kept)
    inner = [
        node.name
        for node in graph.graph.node
        if node.op_type in ("Gemm", "MatMul")
        and node.input[1] in weights
        and node.input[1].startswith("model.")
        and not node.input[1].startswith(beginnings)
    ]
    if not inner:
        raise InputError("export.precision: no layer lies between the network's ends; allowed is fp32")
    return inner
