"""A site's networks: the graphs that are timed, and the one that plays clips and runs on a headset."""

from __future__ import annotations

import gzip
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from torch import Tensor

from memmlp.common.progress import announce
from memmlp.deploy.export import export
from memmlp.deploy.lower_precision import lower
from memmlp.live.rotations import BodyTree
from memmlp.live.spaces import SPACES
from memmlp.live.trackers_to_body_graph import export_full
from memmlp.live.wearer import stature
from memmlp.live.web.weightless_files import without_weights
from memmlp.motion.body import FPS, JOINTS, PARENTS, TRACKED
from memmlp.networks.motion_model import MotionModel, StreamingGraph
from memmlp.networks.streaming import has_stream, streaming

SPACE = SPACES["openxr"]  # of everything on the site
EYES = 0.936
"""The height of the eyes over that of the person (Drillis and Contini 1966, in Winter, Biomechanics and Motor
Control of Human Movement, fig. 4.1), by which a headset tells how tall its wearer is."""

Entry = dict[str, Any]


@dataclass(frozen=True)
class SiteNetwork:
    """A network of a site.

    Attributes:
        key: the network's name in files and in the page's code.
        name: the network's readable name.
        run: the id of the network's run; "random" for random weights.
        model: the network as it was trained.
        clips: the names of those of its test clips that are on the site.
        remark: what people should know who see it move, such as that it is hardly trained; empty for none.
    """

    key: str
    name: str
    run: str
    model: MotionModel
    clips: tuple[str, ...] = ()
    remark: str = ""

    @property
    def trained(self) -> bool:
        """Whether the network is trained, so that it can play clips and be worn; any other is only timed."""
        return self.run != "random"


@dataclass(frozen=True)
class Writer:
    """Writes networks into a site's folder.

    Attributes:
        folder: the site's folder.
        calibration: clips (N, 252) from which the ranges of int8 are found.
        bench: whether to write the graphs that are timed; if not, only those that play clips.
    """

    folder: Path
    calibration: Sequence[Tensor]
    bench: bool = True

    def write(self, network: SiteNetwork) -> Entry:
        """Write a network's graphs, and return the entry that tells the page about them."""
        announce(f"web: export {network.name}")
        model = network.model.cpu().eval()
        stream = streaming(model) if has_stream(model) else None
        with tempfile.TemporaryDirectory() as temporary:
            made = Path(temporary)
            played = self._played(network, stream, made) if network.trained else None
            graphs = self._timed(network, stream, made, played) if self.bench else []
        return {
            "key": network.key,
            "name": network.name,
            "run": network.run,
            "frames": model.frames,
            "fps": FPS,
            "parameters": model.count_parameters(),
            "body": body_of(model.normalizer.rest.double().numpy()),
            "play": played,
            "graphs": graphs,
            "clips": list(network.clips),
            "remark": network.remark,
        }

    def _played(self, network: SiteNetwork, stream: StreamingGraph | None, made: Path) -> Entry:
        """Write the full graph with its weights, which plays clips."""
        path = _whole(made, "streaming" if stream else "naive")
        export_full(stream or network.model, path, network.run, SPACE.name)
        return {"file": self._kept(network.key, path.read_bytes()), "weights": []}

    def _timed(
        self, network: SiteNetwork, stream: StreamingGraph | None, made: Path, played: Entry | None
    ) -> list[Entry]:
        """Write the graphs that are timed: as published, as a stream, and the stream with lower precision."""
        rows = [self._pair(network, network.model, "naive", made, None if stream else played)]
        if stream is not None:
            rows.append(self._pair(network, stream, "streaming", made, played))
            rows += [self._less_precise(network, stream, precision, made) for precision in ("int8", "fp16")]
        return rows

    def _less_precise(
        self, network: SiteNetwork, stream: StreamingGraph, precision: str, made: Path
    ) -> Entry:
        """Write a stream with lower precision; there is no full graph in int8."""
        path, key, whole = made / "less.onnx", f"{network.key}-{precision}", None
        if precision == "fp16":
            lower(precision, _whole(made, "streaming"), path, stream, self.calibration)
            whole = self.weightless(f"{key}-whole", onnx.load(path))
        lower(precision, made / "streaming.onnx", path, stream, self.calibration)
        step = self.weightless(key, onnx.load(path))
        return {"graph": "streaming", "precision": precision, "step": step, "whole": whole}

    def _pair(
        self,
        network: SiteNetwork,
        graph: MotionModel | StreamingGraph,
        name: str,
        made: Path,
        played: Entry | None,
    ) -> Entry:
        """Write two files in float32: the network's step, and the full graph from trackers to joints.

        If `played` is given, that entry is used in place of the full graph, which is not written.
        """
        step, whole = made / f"{name}.onnx", _whole(made, name)
        export(graph, step, network.run)
        if played is None:
            export_full(graph, whole, network.run, SPACE.name)
            played = self.weightless(f"{network.key}-{name}-whole", onnx.load(whole))
        alone = self.weightless(f"{network.key}-{name}", onnx.load(step))
        return {"graph": name, "precision": "fp32", "step": alone, "whole": played}

    def weightless(self, name: str, model: onnx.ModelProto) -> Entry:
        """Write a graph without its weights; return its address and the weights to make at random."""
        drawn = without_weights(model)
        file = self._kept(name, model.SerializeToString())
        return {"file": file, "weights": [part._asdict() for part in drawn]}

    def _kept(self, name: str, content: bytes) -> str:
        """Write a file of the site, compressed, and return its address there."""
        address = f"networks/{name}.onnx.gz"
        (self.folder / address).parent.mkdir(exist_ok=True)
        (self.folder / address).write_bytes(gzip.compress(content, 6, mtime=0))
        return address


def _whole(made: Path, graph: str) -> Path:
    return made / f"{graph}-whole.onnx"


def body_of(rest: np.ndarray) -> Entry:
    """Return what the site's stream has to know of a network's body.

    Args:
        rest: joints in the rest pose (22, 3), metres, SMPL's body frame.

    Returns:
        Head and wrists in the T-pose and the lowest joint's height, in the site's frame of reference, and the
        body's height, metres; and EYES.
    """
    return {
        "rest": (rest[list(TRACKED)] * SPACE.body).tolist(),
        "floor": float(rest[:, 1].min()),
        "height": stature(BodyTree(JOINTS, PARENTS, rest)),
        "eyes": EYES,
    }
