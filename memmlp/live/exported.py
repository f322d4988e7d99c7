"""An exported network, and what its file says about it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from memmlp.common.errors import InputError
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.live.rotations import BodyTree
from memmlp.motion.body import FEATURES

NEEDED = ("joints", "parents", "rest", "fps", "T", "branches", "features")
AGAIN = "export it again with memmlp export RUN --out FILE.onnx"


class ExportedNetwork(OnnxStream):
    """An ONNX file of scope `step`, whose steps are those of `OnnxStream`.

    Attributes:
        sparse: the input (1, 54), to be written before a step.
        rotation6d, position: outputs (22, 6) and (22, 3) of the last step, overwritten by the next.
        body: its joints, their tree and the rest pose.
        fps: frames per second.
        frames: the window's length T.
        branches: what the network learned to predict: rotations, and perhaps positions.

    Raises:
        InputError: if the file is no such network, or lacks some of its metadata.
    """

    def __init__(self, path: Path):
        super().__init__(path)
        self._read(self.session.get_modelmeta().custom_metadata_map)
        self.sparse = self.inputs["sparse"]
        self.rotation6d, self.position = self.outputs["rotation6d"][0], self.outputs["position"][0]

    def _read(self, meta: dict[str, str]) -> None:
        """Read and check the file's metadata."""
        if "tracker_positions" in self.inputs:
            raise InputError(f"{self.path}: an ONNX file of scope full; allowed here is one of scope step")
        if "sparse" not in self.inputs or "fps" not in meta:
            raise InputError(f"{self.path}: no network of memmlp's; allowed is what memmlp export writes")
        missing = [key for key in NEEDED if key not in meta]
        if missing:
            raise InputError(f"{self.path}: an older file, without {', '.join(missing)} in it; {AGAIN}")
        if meta["features"] != FEATURES:
            raise InputError(f"{self.path}: its inputs are not those of this version of memmlp; {AGAIN}")
        try:
            rest = np.array(json.loads(meta["rest"]), np.float64)
            self.body = BodyTree(json.loads(meta["joints"]), json.loads(meta["parents"]), rest)
            self.fps, self.frames = float(meta["fps"]), int(meta["T"])
            self.branches = frozenset(json.loads(meta["branches"]))
        except (ValueError, TypeError, LookupError):
            raise InputError(f"{self.path}: its metadata are damaged; {AGAIN}") from None
        if not 1 <= self.fps <= 1000:
            raise InputError(f"{self.path}: fps={self.fps:g} in its metadata, which are damaged; {AGAIN}")
