"""The files of npm packages that a site contains: onnxruntime-web and three.js, in pinned versions."""

from __future__ import annotations

import gzip
import re
from collections.abc import Mapping
from pathlib import Path

from memmlp.common.npm import ONNXRUNTIME_WEB, THREE, Package, read

DRAWING = {
    "LICENSE": "three/LICENSE",
    "build/three.core.js": "three/three.core.js",
    "build/three.module.js": "three/three.module.js",
    "examples/jsm/controls/OrbitControls.js": "three/OrbitControls.js",
}
WASM = {
    "dist/ort.wasm.bundle.min.mjs": "ort/wasm.js",
    "dist/ort-wasm-simd-threaded.wasm": "ort/wasm.wasm.gz",
}
WEBGPU = {
    "dist/ort.webgpu.bundle.min.mjs": "ort/webgpu.js",
    "dist/ort-wasm-simd-threaded.asyncify.wasm": "ort/webgpu.wasm.gz",
}
"""Where files lie on the site: modules end in .js, which every server knows; .gz are compressed."""


DOCUMENTED = re.compile(rb"^[ \t]*/\*\*(?!\s*\* @license)(?:(?!\*/).)*\*/[ \t]*\n", re.MULTILINE | re.DOTALL)
"""Comments for a library's developers on lines of their own, a third of three.js; licences are kept."""


def write_packages(folder: Path, webgpu: bool) -> dict[str, str]:
    """Write the packages' files into a site's folder, and return the versions by name.

    Raises:
        InputError: if a package can't be downloaded.
    """
    _write(folder, THREE, DRAWING)
    _write(folder, ONNXRUNTIME_WEB, {**WASM, **WEBGPU} if webgpu else WASM)
    return {package.name: package.version for package in (THREE, ONNXRUNTIME_WEB)}


def _write(folder: Path, package: Package, places: Mapping[str, str]) -> None:
    for name, content in read(package, places).items():
        path = folder / places[name]
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(gzip.compress(content, 9, mtime=0) if path.suffix == ".gz" else _bare(content))


def _bare(content: bytes) -> bytes:
    return DOCUMENTED.sub(b"", content)
