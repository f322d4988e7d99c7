"""A .glb file by an independent reading: JSON, accessors, and kinematics of the nodes in plain NumPy."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

COUNTS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}
TYPES = {5121: "u1", 5123: "<u2", 5126: "<f4"}


class Glb:
    def __init__(self, path: Path):
        data = path.read_bytes()
        magic, version, length = struct.unpack_from("<4sII", data)
        assert (magic, version, length) == (b"glTF", 2, len(data))
        size, kind = struct.unpack_from("<I4s", data, 12)
        assert (size % 4, kind) == (0, b"JSON")
        self.json: dict[str, Any] = json.loads(data[20 : 20 + size])
        rest, kind = struct.unpack_from("<I4s", data, 20 + size)
        assert (rest % 4, kind) == (0, b"BIN\0")
        self.binary = data[28 + size :]
        assert len(self.binary) == rest == self.json["buffers"][0]["byteLength"]

    def array(self, index: int) -> np.ndarray:
        """The elements (N, ...) of an accessor, whose bounds must be true."""
        accessor = self.json["accessors"][index]
        view = self.json["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        part = self.binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        width = COUNTS[accessor["type"]]
        values = np.frombuffer(part, TYPES[accessor["componentType"]]).reshape(-1, width)
        assert len(values) == accessor["count"]
        if "min" in accessor:
            assert values.min(0).tolist() == accessor["min"]
            assert values.max(0).tolist() == accessor["max"]
        return values[:, 0] if width == 1 else values

    def channels(self) -> dict[tuple[str, str], tuple[np.ndarray, np.ndarray]]:
        """(node, path) -> times and values."""
        (animation,) = self.json["animations"]
        found = {}
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            assert sampler["interpolation"] == "LINEAR"
            name = self.json["nodes"][channel["target"]["node"]]["name"]
            values = self.array(sampler["input"]), self.array(sampler["output"])
            found[name, channel["target"]["path"]] = values
        return found

    def matrices(self, frame: int | None) -> dict[str, np.ndarray]:
        """node -> matrix (4, 4) to the world, in a frame of the animation or as the nodes are."""
        channels = self.channels() if frame is not None else {}
        found: dict[str, np.ndarray] = {}

        def visit(index: int, above: np.ndarray) -> None:
            node = self.json["nodes"][index]
            shift = np.array(node.get("translation", (0, 0, 0)), float)
            turn = np.array(node.get("rotation", (0, 0, 0, 1)), float)
            shift, turn = (
                channels[node["name"], path][1][frame].astype(float)
                if (node["name"], path) in channels
                else own
                for path, own in (("translation", shift), ("rotation", turn))
            )
            local = np.eye(4)
            local[:3, :3], local[:3, 3] = Rotation.from_quat(turn).as_matrix(), shift
            found[node["name"]] = above @ local
            for child in node.get("children", ()):
                visit(child, found[node["name"]])

        for root in self.json["scenes"][self.json["scene"]]["nodes"]:
            visit(root, np.eye(4))
        return found

    def vertices(self, frame: int | None) -> np.ndarray:
        skin, attributes = self.json["skins"][0], self.json["meshes"][0]["primitives"][0]["attributes"]
        inverse = self.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)  # by columns
        world = self.matrices(frame)
        names = [self.json["nodes"][joint]["name"] for joint in skin["joints"]]
        matrices = np.stack([world[name] for name in names]) @ inverse
        points = np.pad(self.array(attributes["POSITION"]), ((0, 0), (0, 1)), constant_values=1)
        weights = self.array(attributes["WEIGHTS_0"])
        np.testing.assert_array_equal(weights.sum(1), 1)
        blended = (matrices[self.array(attributes["JOINTS_0"])] * weights[..., None, None]).sum(1)
        return np.einsum("vij,vj->vi", blended, points)[:, :3]
