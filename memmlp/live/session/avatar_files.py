"""The files that the page needs for a VRM avatar: the avatar itself, and three-vrm from its npm package.

The page's own three.js is replaced by the three.js of the npm package to which the loader belongs.
"""

from __future__ import annotations

import json
import struct
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from memmlp.common import npm
from memmlp.common.errors import InputError, why_unreadable
from memmlp.live.session.page_server import FILES, HTML, SCRIPT, File, read_page
from memmlp.motion.formats.vrm import write_vrm

THREE = ("build/three.module.js", "build/three.core.js", "examples/jsm/loaders/GLTFLoader.js",
         "examples/jsm/utils/BufferGeometryUtils.js", "examples/jsm/utils/SkeletonUtils.js")  # fmt: skip
THREE_VRM = ("lib/three-vrm.module.min.js",)
EXTENSIONS = ("VRMC_vrm", "VRM")  # of VRM 1.0, and 0.x


def mannequin_vrm(rest: np.ndarray) -> bytes:
    """Return the project's own avatar as a VRM file, with the given rest joints (22, 3), metres."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mannequin.vrm"
        write_vrm(path, rest)
        return path.read_bytes()


def read_vrm(path: Path) -> bytes:
    """Return a VRM file's content. Raises InputError if the file is no VRM file."""
    try:
        content = path.read_bytes()
        if content[:4] != b"glTF":
            raise ValueError("no binary glTF")
        (size,) = struct.unpack_from("<I", content, 12)
        extensions = json.loads(content[20 : 20 + size]).get("extensions", {})
    except (OSError, ValueError, struct.error, AttributeError) as error:
        raise InputError(f"--avatar {path}: {why_unreadable(error)}; allowed is a VRM file") from None
    if not any(name in extensions for name in EXTENSIONS):
        raise InputError(f"--avatar {path}: a glTF file without a VRM avatar; allowed is a VRM file")
    return content


def avatar_files(vrm: bytes) -> dict[str, File]:
    """Return the page's files with an avatar. Raises InputError if an npm package can't be downloaded."""
    scripts = _of(npm.THREE, THREE) | _of(npm.THREE_VRM, THREE_VRM)
    files = {f"npm/{name}": File(SCRIPT, _given(content)) for name, content in scripts.items()}
    model = {"avatar.vrm": File("model/gltf-binary", _given(vrm)), "": File(HTML, _page)}
    return FILES | files | model


def _of(package: npm.Package, names: tuple[str, ...]) -> dict[str, bytes]:
    return npm.read(package, names)


def _given(content: bytes) -> Callable[[], bytes]:
    return partial(bytes, content)


def _page() -> bytes:
    """Return the page, changed to use the three.js of the npm package."""
    return read_page("index.html").replace(b"./three/three.module.min.js", b"./npm/build/three.module.js")
