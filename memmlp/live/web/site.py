"""A site as a folder of static files: the page, packages, networks, clips, and a service worker."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from memmlp import __version__
from memmlp.common.errors import InputError
from memmlp.common.files import file_digest, now, read_json
from memmlp.common.lease import publish, temporary
from memmlp.common.npm import ONNXRUNTIME_WEB, THREE, read
from memmlp.deploy.latency import yardstick
from memmlp.live.rotations import matrix_to_quaternion
from memmlp.live.session.loop import TOP
from memmlp.live.session.sources import TrackedClip
from memmlp.live.spaces import SPACES
from memmlp.live.web.networks import SiteNetwork, write_network, write_weightless
from memmlp.motion.body import FPS, JOINTS
from memmlp.motion.limb_shapes import HEAT, LIMBS

ABOUT = "site.json"
PAGES: dict[str, tuple[str, ...] | None] = {
    "memmlp.live.web": None,
    "memmlp.live.session": ("stage.js", "history.js"),
    "memmlp.common": ("theme.js", "dom.js", "style.css"),
}
"""The packages whose files of pages a site uses, and which; None for all."""
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
"""Where files of npm packages lie on the site: modules end in .js, which every server knows; .gz are
compressed."""
DOCUMENTED = re.compile(rb"^[ \t]*/\*\*(?!\s*\* @license)(?:(?!\*/).)*\*/[ \t]*\n", re.MULTILINE | re.DOTALL)
"""Comments for a library's developers on lines of their own, a third of three.js; licences are kept."""

NUMBERS = 9 + 12 + 66
"""Numbers per frame: positions and quaternions (xyzw) of head and wrists, joints; metres, openxr axes."""


class SiteClip(NamedTuple):
    """A clip of a site.

    Attributes:
        key: the clip's name in files: a digest of its content.
        name: the clip's readable name.
        content: little-endian float32 (frames, 87).
    """

    key: str
    name: str
    content: bytes

    @property
    def frames(self) -> int:
        """Number of the clip's frames, at 60 Hz."""
        return len(self.content) // (4 * NUMBERS)


def pack_clip(name: str, frames: np.ndarray, seconds: float) -> SiteClip:
    """Return the middle part of a clip.

    Args:
        name: the clip's name.
        frames: [X | Theta] (N, 252) at 60 Hz, world (`memmlp.motion.body`).
        seconds: the longest duration of the part.
    """
    count = min(len(frames), round(seconds * FPS))
    first = (len(frames) - count) // 2
    clip, space = TrackedClip(name, frames[first : first + count]), SPACES["openxr"]
    rotations = matrix_to_quaternion(space.rotations_out(clip.rotations).reshape(-1, 3, 3))
    parts = [space.positions_out(clip.positions), rotations, space.positions_out(clip.joints)]
    content = np.concatenate([part.reshape(count, -1) for part in parts], 1).astype("<f4").tobytes()
    return SiteClip(hashlib.sha256(content).hexdigest()[:12], name, content)


@dataclass(frozen=True)
class Site:
    """The contents of a site.

    Attributes:
        networks: the networks; those that are trained play clips and run on headsets.
        base: the network that the others' times are compared with; None for a site without a bench.
        clips: the clips that can be played.
        calibration: clips (N, 252) from which the ranges of int8 are found, for the bench.
        webgpu: whether the site has the files that WebGPU needs.
    """

    networks: Sequence[SiteNetwork]
    base: SiteNetwork | None
    clips: Sequence[SiteClip]
    calibration: Sequence[Tensor]
    webgpu: bool = True

    def make(self, out: Path) -> int:
        """Write the site, completely or not at all, and return its size in bytes.

        An earlier site in that folder is replaced.

        Raises:
            InputError: if the folder holds something else, or a package can't be downloaded.
        """
        check_place(out)
        unfinished = temporary(out)
        try:
            unfinished.mkdir(parents=True)
            self._fill(unfinished)
            total = sum(path.stat().st_size for path in _files(unfinished))
            earlier = temporary(out)
            if out.exists():
                out.rename(earlier)
            publish(unfinished, out)
            shutil.rmtree(earlier, ignore_errors=True)
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)
        return total

    def _fill(self, folder: Path) -> None:
        bench = self.base is not None
        places = {THREE: DRAWING, ONNXRUNTIME_WEB: {**WASM, **WEBGPU} if self.webgpu else WASM}
        for package, files in places.items():
            for name, content in read(package, files).items():
                small = gzip.compress(content, 9, mtime=0) if files[name].endswith(".gz") else None
                _write(folder / files[name], small or DOCUMENTED.sub(b"", content))
        clips = []
        for clip in self.clips:
            file = f"clips/{clip.key}.gz"
            _write(folder / file, gzip.compress(clip.content, 9, mtime=0))
            clips.append({"key": clip.key, "name": clip.name, "file": file, "frames": clip.frames})
        about: dict[str, Any] = {
            "memmlp": __version__,
            "made": now(),
            "packages": {package.name: package.version for package in places},
            "backends": ["wasm", "webgpu"] if self.webgpu else ["wasm"],
            "networks": [write_network(folder, one, self.calibration, bench) for one in self.networks],
            "clips": clips,
            "limbs": [{"start": a, "end": b, "radii": radii, "tip": tip} for a, b, radii, tip in LIMBS],
            "joints": JOINTS,
            "heat": HEAT,
            "top": TOP,
        }
        if self.base is not None:
            about["base"] = write_network(folder, self.base, self.calibration, bench)
            about["yardstick"] = write_weightless(folder, "yardstick", yardstick())
        _write(folder / ABOUT, (json.dumps(about, separators=(",", ":")) + "\n").encode())
        _write_page(folder)


def check_place(out: Path) -> None:
    """Raise InputError if no site may be written there: over other content, or in place of a file."""
    expected = "expected a new folder, or an earlier site"
    if out.exists() and not out.is_dir():
        raise InputError(f"--out {out}: is a file; {expected}")
    if out.is_dir() and any(out.iterdir()) and "packages" not in read_json(out / ABOUT):
        raise InputError(f"--out {out}: has other content; {expected}")
    if not out.absolute().parent.is_dir():
        raise InputError(f"--out {out}: there is no folder {out.parent}")


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)


def _write_page(folder: Path) -> None:
    """Write the page's files, with its policy, and a service worker that lists all files of the site.

    The Content-Security-Policy allows no other hosts; scripts are files, or the import map. The worker's
    version changes with any file.
    """
    for package, names in PAGES.items():
        page = resources.files(package).joinpath("page")
        for name in names or tuple(path.name for path in page.iterdir()):
            _write(folder / name, page.joinpath(name).read_bytes())
    index = (folder / "index.html").read_text("utf-8")
    inline = re.search(r'<script type="importmap">(.*?)</script>', index, re.DOTALL)
    assert inline is not None
    digest = base64.b64encode(hashlib.sha256(inline[1].encode()).digest()).decode()
    policy = (
        f"default-src 'none'; script-src 'self' 'wasm-unsafe-eval' 'sha256-{digest}'; worker-src 'self'; "
        "style-src 'self' 'unsafe-inline'; img-src 'self' data:; connect-src 'self'; base-uri 'none'; "
        "form-action 'none'"
    )
    _write(folder / "index.html", index.replace("POLICY", policy).encode())
    worker = folder / "sw.js"
    digests = {str(file.relative_to(folder).as_posix()): file_digest(file) for file in _files(folder)}
    version = hashlib.sha256(json.dumps(digests).encode()).hexdigest()[:16]
    others = [name for name in digests if name != worker.name]
    head = f"const VERSION = {json.dumps(version)};\nconst FILES = {json.dumps(others)};\n"
    _write(worker, head.encode() + worker.read_bytes())
