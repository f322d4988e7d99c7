"""Export of one streaming step to ONNX. The state is an explicit input and output; docs/guides/onnx.md
describes all of them."""

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
from torch.fx import config as fx_config

from memmlp import __version__
from memmlp.common.files import naming_file
from memmlp.common.lease import publish_at_end
from memmlp.deploy.opsets import NATIVE, convert_opset
from memmlp.deploy.parity import disable_sampling
from memmlp.motion.body import FEATURES, FPS, JOINTS, N_JOINTS, PARENTS, POSITION, ROTATION, SPARSE_DIM
from memmlp.networks.motion_model import MotionModel, StreamingGraph


class OneStep(nn.Module):
    """One step of the live stream. Its inputs and outputs are flat, because ONNX requires it."""

    def __init__(self, model: MotionModel | StreamingGraph):
        super().__init__()
        self.model = model
        self.names = list(model.initial_state(1))

    def forward(self, sparse: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """Return rotations (1, 22, 6), positions (1, 22, 3) and the new state for `sparse` (1, 54)."""
        motion, new = self.model.advance_frame(sparse, dict(zip(self.names, state, strict=True)))
        rotation = motion[:, ROTATION].unflatten(-1, (N_JOINTS, 6))
        position = motion[:, POSITION].unflatten(-1, (N_JOINTS, 3))
        return rotation, position, *(new[name] for name in self.names)


def export(model: MotionModel | StreamingGraph, path: Path, run_id: str, opset: int = NATIVE) -> None:
    """Write the model's streaming step and its metadata as an ONNX file for the CPU in float32. Raises
    InputError if the step can't be converted to the opset."""
    step = OneStep(model.cpu().eval())
    names = [f"state.{name}" for name in step.names]
    export_module(
        step,
        (torch.zeros(1, SPARSE_DIM), *model.initial_state(1).values()),
        ["sparse", *names],
        ["rotation6d", "position", *(f"{name}.next" for name in names)],
        path,
        make_metadata(model, run_id),
        opset,
    )


def export_module(
    step: nn.Module,
    arguments: tuple[Tensor, ...],
    inputs: list[str],
    outputs: list[str],
    path: Path,
    meta: dict[str, str],
    opset: int = NATIVE,
) -> None:
    """Write a module as one ONNX file, atomically. `arguments` are examples for its `forward` method; they
    and the outputs get the given names. Raises InputError if the step can't be converted to the opset."""
    with silence_exporter(), disable_sampling(step):
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
    graph = convert_opset(program.model_proto, opset)
    onnx.helper.set_model_props(graph, meta)
    with publish_at_end(path) as unfinished, naming_file(path):
        onnx.save(graph, unfinished)


@contextmanager
def silence_exporter() -> Iterator[None]:
    """Suppress the exporter's warnings and its nodes' stack traces, because users cannot act on them."""
    traced = getattr(fx_config, "do_not_emit_stack_traces", False)  # older versions do not know it
    fx_config.do_not_emit_stack_traces = True
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "onnx_ir", "onnxscript")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        fx_config.do_not_emit_stack_traces = traced
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def simplify(model: onnx_ir.Model) -> None:
    """Fold constants, and remove unused and duplicate nodes and the exporter's notes. The exporter's own
    optimiser also tries rewriting rules, which rarely apply to these graphs, and take up to half of the
    export time. The notes contain local paths and source code, which can be more than half of a small file.
    """
    common.InlinePass()(model)
    for node in model.graph:
        # Some layers are a transpose and a product. Folding renames the transposed weight. The new name must
        # begin with the old one, because lower precisions find layers by these names.
        weight = node.inputs[0] if node.op_type == "Transpose" else None
        if weight and weight.is_initializer() and str(weight.name).endswith("weight"):
            node.outputs[0].name = f"{weight.name}.{node.outputs[0].name}"
    fold_constants(model, onnx_shape_inference=True)
    onnx_ir.passes.Sequential(
        common.RemoveUnusedNodesPass(),
        common.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
        common.DeduplicateInitializersPass(),
        common.CommonSubexpressionEliminationPass(),
        common.OutputFixPass(),
        common.NameFixPass(),
    )(model)
    graph = model.graph
    graph.metadata_props.clear()
    outputs = (value for node in graph for value in node.outputs)
    for noted in (*graph, *outputs, *graph.inputs, *graph.outputs, *graph.initializers.values()):
        noted.metadata_props.clear()


def make_metadata(model: MotionModel | StreamingGraph, run_id: str) -> dict[str, str]:
    """Return the metadata that a program needs to run the exported file."""
    origin = {"weights": model.origin} if model.origin else {}
    return origin | {
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
