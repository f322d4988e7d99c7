"""Export of one streaming step to ONNX, with its state explicit.

Inputs: `sparse` (1, 54), the world features of the newest frame (order: memmlp.motion.body), and `state.*`,
all zeros for a fresh start. Outputs: `rotation6d` (1, 22, 6) local rotations, `position` (1, 22, 3) metres in
the world (from the position branch, or from forward kinematics for networks without one), and the new
`state.*` under the same names with the suffix `.next`.
"""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import onnx
import onnx_ir
import torch
from onnx_ir.passes import common
from onnxscript.optimizer import fold_constants
from torch import Tensor, nn

from memmlp import __version__
from memmlp.common.lease import publish, temporary_path
from memmlp.deploy.opsets import NATIVE, convert
from memmlp.deploy.parity import deterministic
from memmlp.motion.body import FEATURES, FPS, JOINTS, N_JOINTS, PARENTS, POSITION, ROTATION, SPARSE_DIM
from memmlp.networks.motion_model import MotionModel, StreamingGraph


class OneStep(nn.Module):
    """One step of the live stream with flat inputs and outputs, which ONNX needs."""

    def __init__(self, model: MotionModel | StreamingGraph):
        super().__init__()
        self.model = model
        self.names = list(model.initial_state(1))

    def forward(self, sparse: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """Map `sparse` (1, 54) and the state to (1, 22, 6) rotations, (1, 22, 3) positions, the new state."""
        motion, new = self.model.advance(sparse[:, None], dict(zip(self.names, state, strict=True)), 1)
        last = motion[:, -1]
        rotation = last[:, ROTATION].unflatten(-1, (N_JOINTS, 6))
        position = last[:, POSITION].unflatten(-1, (N_JOINTS, 3))
        return rotation, position, *(new[name] for name in self.names)


def export(model: MotionModel | StreamingGraph, path: Path, run_id: str, opset: int = NATIVE) -> None:
    """Write the model's streaming step, on the CPU in float32, as one ONNX file with its metadata.

    Raises:
        InputError: for an opset to which the step can't be converted.
    """
    step = OneStep(model.cpu().eval())
    names = [f"state.{name}" for name in step.names]
    save(
        step,
        (torch.zeros(1, SPARSE_DIM), *model.initial_state(1).values()),
        ["sparse", *names],
        ["rotation6d", "position", *(f"{name}.next" for name in names)],
        path,
        metadata(model, run_id),
        opset,
    )


def save(
    step: nn.Module,
    arguments: tuple[Tensor, ...],
    inputs: list[str],
    outputs: list[str],
    path: Path,
    meta: dict[str, str],
    opset: int = NATIVE,
) -> None:
    """Write a step as one ONNX file, atomically.

    Args:
        step: the module to export.
        arguments: example arguments of its `forward`.
        inputs: the arguments' names in the file.
        outputs: names of its outputs in the file.
        path: the file to write.
        meta: the file's metadata.
        opset: one of memmlp.deploy.opsets.OPSETS.

    Raises:
        InputError: for an opset to which the step can't be converted.
    """
    with silence_exporter(), deterministic(step):
        program = torch.onnx.export(
            step,
            arguments,
            input_names=inputs,
            output_names=outputs,
            opset_version=NATIVE,
            dynamo=True,
            verbose=False,
            optimize=False,
        )
        assert program is not None
        simplify(program.model)
    graph = convert(program.model_proto, opset)
    onnx.helper.set_model_props(graph, meta)
    unfinished = temporary_path(path)
    try:
        onnx.save(graph, unfinished)
        publish(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


@contextmanager
def silence_exporter() -> Iterator[None]:
    """Keep the exporter's warnings from users, who can do nothing about them."""
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "onnx_ir", "onnxscript")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def simplify(model: onnx_ir.Model) -> None:
    """Fold a graph's constants, and remove unused and duplicate parts and the exporter's notes.

    The exporter's own optimiser does the same, but also tries its rewriting rules, which find next to nothing
    in these graphs and take up to half of an export's time. The notes hold paths of the exporting machine
    and lines of source code, and were more than half of a small network's file.
    """
    common.InlinePass()(model)
    for node in model.graph:
        # Some layers are a transpose and a product. Folding renames the transposed weight; its name has to
        # begin with the weight's, by which lower precisions find layers.
        weight = node.inputs[0] if node.op_type == "Transpose" else None
        if weight and weight.is_initializer() and str(weight.name).endswith("weight"):
            node.outputs[0].name = f"{weight.name}.{node.outputs[0].name}"
    fold_constants(model, onnx_shape_inference=True)
    SIMPLER(model)
    graph = model.graph
    graph.metadata_props.clear()
    made = (value for node in graph for value in node.outputs)
    for noted in (*graph, *made, *graph.inputs, *graph.outputs, *graph.initializers.values()):
        noted.metadata_props.clear()


SIMPLER = onnx_ir.passes.Sequential(
    common.RemoveUnusedNodesPass(),
    common.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
    common.DeduplicateInitializersPass(),
    common.CommonSubexpressionEliminationPass(),
    common.OutputFixPass(),
    common.NameFixPass(),
)
"""The passes that simplify a graph once its constants are folded."""


def metadata(model: MotionModel | StreamingGraph, run_id: str) -> dict[str, str]:
    """Return the metadata by which a program drives the file."""
    return {
        "joints": json.dumps(JOINTS),
        "parents": json.dumps(PARENTS),
        "rest": json.dumps(model.normalizer.rest.tolist()),
        "branches": json.dumps(sorted(model.branches)),
        "fps": str(FPS),
        "T": str(model.frames),
        "features": FEATURES,
        "memmlp_version": __version__,
        "run_id": run_id,
    }
