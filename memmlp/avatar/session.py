"""An exported network in ONNX Runtime, on one thread, with its state; and what its file tells of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from memmlp.avatar.rotations import Skeleton
from memmlp.body import FEATURES
from memmlp.errors import InputError

NEEDED = ("joints", "parents", "rest", "fps", "T", "branches", "features")
AGAIN = "export it again with memmlp export RUN --out FILE.onnx"


class Network:
    """An ONNX file of scope `network`. Raises InputError where a file is none, or lacks what must be known.

    Inputs, outputs and states are arrays that are bound once: a step writes the new state beside the old one,
    and the two change places, so that nothing is allocated or copied.

    Attributes:
        sparse: input (1, 54), to be written before a step.
        rotation6d, position: outputs (22, 6) and (22, 3) of the last step, overwritten by the next.
        skeleton, fps, frames, branches: joints, tree and rest pose; frames per second; T; what is learned.
    """

    def __init__(self, path: Path):
        self.path = path
        self.session = open_session(path)
        inputs = {i.name: i.shape for i in self.session.get_inputs()}
        self._read(self.session.get_modelmeta().custom_metadata_map, inputs)
        self.sparse = np.zeros(inputs.pop("sparse"), np.float32)
        outputs = {o.name: np.zeros(o.shape, np.float32) for o in self.session.get_outputs()}
        self.rotation6d, self.position = outputs["rotation6d"][0], outputs["position"][0]
        self.states = [
            {name: np.zeros(shape, np.float32) for name, shape in inputs.items()} for _ in range(2)
        ]
        self._bindings = [self._bound(old, new, outputs) for old, new in (self.states, self.states[::-1])]

    def _read(self, meta: dict[str, str], inputs: dict[str, Any]) -> None:
        """What the metadata tell."""
        if "tracker_positions" in inputs:
            raise InputError(f"{self.path}: an ONNX file of scope full; allowed here is one of scope network")
        if "sparse" not in inputs or "fps" not in meta:
            raise InputError(f"{self.path}: no network of memmlp's; allowed is what memmlp export writes")
        missing = [key for key in NEEDED if key not in meta]
        if missing:
            raise InputError(f"{self.path}: an older file, without {', '.join(missing)} in it; {AGAIN}")
        if meta["features"] != FEATURES:
            raise InputError(f"{self.path}: its inputs are not those of this version of memmlp; {AGAIN}")
        rest = np.array(json.loads(meta["rest"]))
        self.skeleton = Skeleton(json.loads(meta["joints"]), json.loads(meta["parents"]), rest)
        self.fps, self.frames = float(meta["fps"]), int(meta["T"])
        self.branches = frozenset(json.loads(meta["branches"]))

    def _bound(
        self, old: dict[str, np.ndarray], new: dict[str, np.ndarray], outputs: dict[str, np.ndarray]
    ) -> onnxruntime.IOBinding:
        """A step from one set of state arrays to the other."""
        binding = self.session.io_binding()
        for name, array in {"sparse": self.sparse, **old}.items():
            binding.bind_input(name, "cpu", 0, np.float32, array.shape, array.ctypes.data)
        for name, array in (outputs | {f"{name}.next": array for name, array in new.items()}).items():
            binding.bind_output(name, "cpu", 0, np.float32, array.shape, array.ctypes.data)
        return binding

    def reset(self) -> None:
        """A fresh start."""
        for state in self.states[0].values():
            state[:] = 0

    def peek(self) -> None:
        """A step whose new state is not kept."""
        self.session.run_with_iobinding(self._bindings[0])

    def step(self) -> None:
        """A step."""
        self.peek()
        self.states.reverse()
        self._bindings.reverse()


def open_session(path: Path) -> onnxruntime.InferenceSession:
    """An ONNX file in ONNX Runtime on one thread. Raises InputError where it is none."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; allowed: what memmlp export writes, or a run's folder")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its own kinds of error have no common name
        raise InputError(
            f"{path}: no ONNX file that runs here ({' '.join(str(error).split())[:120]})"
        ) from error
