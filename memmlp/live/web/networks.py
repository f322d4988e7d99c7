"""A site's networks: the graphs that are timed, and the one that plays clips and runs on a headset."""

from __future__ import annotations

import gzip
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnx
from onnx import TensorProto, numpy_helper
from onnx.external_data_helper import set_external_data
from torch import Tensor

from memmlp.common.progress import announce
from memmlp.deploy.export import export
from memmlp.deploy.lower_precision import lower
from memmlp.live.rotations import BodyTree
from memmlp.live.spaces import SPACES
from memmlp.live.trackers_to_body_graph import export_full
from memmlp.live.wearer import stature
from memmlp.motion.body import FPS, JOINTS, PARENTS, TRACKED
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.streaming import has_stream, streaming

SPACE = SPACES["openxr"]  # of everything on the site
EYES = 0.936
"""The height of the eyes over that of the person (Drillis and Contini 1966, in Winter, Biomechanics and Motor
Control of Human Movement, fig. 4.1), from which a headset estimates its wearer's height."""

LOCATION = "weights"  # the name by which the page hands drawn weights to ONNX Runtime
LEAST = 32_768  # bytes; smaller tensors, such as those of normalisation, and constants, stay in the file
ALIGNED = 64  # bytes
KINDS = {TensorProto.FLOAT: "float32", TensorProto.FLOAT16: "float16", TensorProto.INT8: "int8"}

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
        remark: a warning that the page shows, such as that it is hardly trained; empty for no warning.
    """

    key: str
    name: str
    run: str
    model: MotionModel
    clips: tuple[str, ...] = ()
    remark: str = ""


def write_network(folder: Path, network: SiteNetwork, calibration: Sequence[Tensor], bench: bool) -> Entry:
    """Write a network's graphs into a site's folder.

    Args:
        folder: the site's folder.
        network: the network; one with random weights is only timed.
        calibration: clips (N, 252) from which the ranges of int8 are found.
        bench: whether to write the graphs that are timed; if not, only the one that plays clips.

    Returns:
        The entry about them in the site's description. The graphs that are timed are the network as
        published, its stream, and the stream in lower precision, each as the step alone and as the full graph
        from trackers to joints. There is no full graph in int8.
    """
    announce(f"web: export {network.name}")
    model = network.model.cpu().eval()
    nets: dict[str, Any] = {"naive": model}
    if has_stream(model):
        nets["streaming"] = streaming(model)
    best, key = list(nets)[-1], network.key
    played, rows = None, []
    with tempfile.TemporaryDirectory() as temporary:
        step, whole, lowered = (Path(temporary) / f"{name}.onnx" for name in ("step", "whole", "lower"))
        for name, graph in nets.items():
            if bench or (network.run != "random" and name == best):
                export_full(graph, whole, network.run, SPACE.name)
            if network.run != "random" and name == best:
                played = {"file": _write(folder, key, whole.read_bytes()), "weights": []}
            if bench:
                export(graph, step, network.run)
                full = played if name == best else None
                full = full or write_weightless(folder, f"{key}-{name}-whole", onnx.load(whole))
                alone = write_weightless(folder, f"{key}-{name}", onnx.load(step))
                rows.append({"graph": name, "precision": "fp32", "step": alone, "whole": full})
        for precision in ("int8", "fp16") if bench and best == "streaming" else ():
            files: Entry = {"step": step} | ({"whole": whole} if precision == "fp16" else {})
            row: Entry = {"graph": best, "precision": precision, "whole": None}
            for part, source in files.items():
                lower(precision, source, lowered, nets[best], calibration)
                ending = "-whole" if part == "whole" else ""
                row[part] = write_weightless(folder, f"{key}-{precision}{ending}", onnx.load(lowered))
            rows.append(row)
    return {
        "key": key,
        "name": network.name,
        "run": network.run,
        "frames": model.frames,
        "fps": FPS,
        "parameters": model.count_parameters(),
        "body": describe_body(model.normalizer.rest.double().numpy()),
        "play": played,
        "graphs": rows,
        "clips": list(network.clips),
        "remark": network.remark,
    }


def describe_body(rest: np.ndarray) -> Entry:
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


def _write(folder: Path, name: str, content: bytes) -> str:
    """Write a graph, compressed, and return its address on the site."""
    address = f"networks/{name}.onnx.gz"
    (folder / address).parent.mkdir(exist_ok=True)
    (folder / address).write_bytes(gzip.compress(content, 6, mtime=0))
    return address


def write_weightless(folder: Path, name: str, model: onnx.ModelProto) -> Entry:
    """Write a graph without its weights; return its address and the weights to make at random."""
    drawn = remove_weights(model)
    return {
        "file": _write(folder, name, model.SerializeToString()),
        "weights": [part._asdict() for part in drawn],
    }


class Drawn(NamedTuple):
    """A tensor whose numbers the page makes at random.

    Attributes:
        offset: where the tensor begins among all drawn tensors of the graph, bytes.
        size: how many numbers the tensor has.
        kind: the numbers' type: float32, float16 or int8.
        scale: the numbers' standard deviation about 0, that of the weights which they replace.
    """

    offset: int
    size: int
    kind: str
    scale: float


def remove_weights(model: onnx.ModelProto) -> list[Drawn]:
    """Remove the large weights from a graph, and return the tensors to draw in their place.

    The weights' values do not matter for a step's time, and graphs without them keep a site small. Drawn
    numbers of about the same size keep the operations' speed: none becomes infinite, or so small that a
    processor takes longer over it.
    """
    drawn, end = [], 0
    for tensor in model.graph.initializer:
        kind, size = KINDS.get(tensor.data_type), len(tensor.raw_data)
        if kind is None or size < LEAST:
            continue
        values = numpy_helper.to_array(tensor)
        scale = float(np.sqrt(np.square(values.astype(np.float64)).mean()))
        if not np.isfinite(scale):  # a mask
            continue
        drawn.append(Drawn(end, values.size, kind, scale))
        set_external_data(tensor, LOCATION, end, size)
        tensor.ClearField("raw_data")
        end += -(-size // ALIGNED) * ALIGNED
    return drawn
