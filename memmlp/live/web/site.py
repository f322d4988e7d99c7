"""Writes a static website: the page, ONNX Runtime, networks, clips, and a service worker."""

import gzip
import hashlib
import json
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from memmlp import __version__
from memmlp.common.errors import InputError
from memmlp.common.files import file_digest, naming_file, now, read_json
from memmlp.common.lease import publish_at_end, temporary_path
from memmlp.common.npm import ONNXRUNTIME_WEB, read_package_files
from memmlp.common.page_server import build_security_policy, read_page_file
from memmlp.common.progress import announce
from memmlp.live.rotations import BodyTree, matrix_to_quaternion
from memmlp.live.session.loop import TOP
from memmlp.live.session.sources import TrackedClip
from memmlp.live.spaces import SPACES
from memmlp.live.trackers_to_body_graph import export_full
from memmlp.live.wearer import compute_body_height
from memmlp.motion.body import FPS, HEAT, JOINTS, LIMBS, TRACKED
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.streaming import has_streaming_graph, make_streaming_graph

ABOUT = "site.json"
SPACE = SPACES["openxr"]  # the frame of reference of all poses on the site
OTHER_PAGES = {
    "memmlp.live.session": (
        "viewer.js", "stage.js", "live.css", "three/three.module.min.js", "three/three.core.min.js",
        "three/OrbitControls.js", "three/LICENSE",
    ),
    "memmlp.common": ("dom.js", "style.css"),
}  # fmt: skip
"""Files from other pages of memmlp, by package."""
RUNTIME = {
    "dist/ort.wasm.bundle.min.mjs": "ort/wasm.js",
    "dist/ort-wasm-simd-threaded.wasm": "ort/wasm.wasm.gz",
}
"""Paths of ONNX Runtime's files in its package and on the site. All servers support the suffix .js."""
EYES = 0.936
"""Eye height divided by body height (Drillis and Contini 1966, in Winter, Biomechanics and Motor Control of
Human Movement, fig. 4.1). The page estimates the user's height from the height of the headset."""
NUMBERS = 9 + 12 + 66
"""Number of values per frame: positions (metres) and quaternions (xyzw) of head and wrists, and joint
positions, in openxr axes."""

Entry = dict[str, Any]


@dataclass(frozen=True)
class SiteNetwork:
    """A network on a site: `key` is its name in file names and the page's code, `name` its display name,
    `run` its run's id. `clips` are its test clips on the site. `remark` is a warning on the page; empty for
    none."""

    key: str
    name: str
    run: str
    model: MotionModel
    clips: tuple[str, ...] = ()
    remark: str = ""


class SiteClip(NamedTuple):
    """A clip on a site: `key`, a digest of the content, in file names, the display name, and little-endian
    float32 (frames, 87)."""

    key: str
    name: str
    content: bytes

    @property
    def frames(self) -> int:
        """Number of frames at 60 Hz."""
        return len(self.content) // (4 * NUMBERS)


def pack_clip(name: str, frames: np.ndarray, seconds: float) -> SiteClip:
    """Return the middle part of a clip, at most `seconds` long, from frames [X | Theta] (N, 252) at 60 Hz,
    world."""
    count = min(len(frames), round(seconds * FPS))
    first = (len(frames) - count) // 2
    clip = TrackedClip(name, frames[first : first + count])
    rotations = matrix_to_quaternion(SPACE.convert_rotations_from_amass(clip.rotations).reshape(-1, 3, 3))
    positions, joints = map(SPACE.convert_positions_from_amass, (clip.positions, clip.joints))
    parts = [positions, rotations, joints]
    content = np.concatenate([part.reshape(count, -1) for part in parts], 1).astype("<f4").tobytes()
    return SiteClip(hashlib.sha256(content).hexdigest()[:12], name, content)


@dataclass(frozen=True)
class Site:
    """The contents of a site: networks, which play clips and run on headsets, and the clips to play."""

    networks: Sequence[SiteNetwork]
    clips: Sequence[SiteClip]

    def write(self, out: Path) -> int:
        """Write the site atomically in place of an earlier one, and return its size in bytes. Raises
        InputError if the folder has other content, or ONNX Runtime cannot be downloaded."""
        check_site_folder(out)
        earlier = temporary_path(out)
        with publish_at_end(out) as unfinished:
            unfinished.mkdir(parents=True)
            with naming_file(out):
                self._write_contents(unfinished)
            total = sum(path.stat().st_size for path in unfinished.rglob("*") if path.is_file())
            if out.exists():
                out.rename(earlier)
        shutil.rmtree(earlier, ignore_errors=True)
        return total

    def _write_contents(self, folder: Path) -> None:
        for name, content in read_package_files(ONNXRUNTIME_WEB, RUNTIME).items():
            _write_file(folder, RUNTIME[name], content)
        for clip in self.clips:
            _write_file(folder, f"clips/{clip.key}.gz", clip.content)
        about: Entry = {
            "memmlp": __version__,
            "made": now(),
            "packages": {ONNXRUNTIME_WEB.name: ONNXRUNTIME_WEB.version},
            "networks": [write_network(folder, one) for one in self.networks],
            "clips": [
                {"key": clip.key, "name": clip.name, "frames": clip.frames, "file": f"clips/{clip.key}.gz"}
                for clip in self.clips
            ],
            "limbs": [limb._asdict() for limb in LIMBS],
            "joints": JOINTS,
            "heat": HEAT,
            "top": TOP,
        }
        _write_file(folder, ABOUT, (json.dumps(about, separators=(",", ":")) + "\n").encode())
        _write_page(folder)


def check_site_folder(out: Path) -> None:
    """Raise InputError unless `out` is a new folder or an earlier site."""
    expected = "expected a new folder, or an earlier site"
    if out.exists() and not out.is_dir():
        raise InputError(f"--out {out}: is a file; {expected}")
    if out.is_dir() and any(out.iterdir()) and "packages" not in read_json(out / ABOUT):
        raise InputError(f"--out {out}: has other content; {expected}")
    if not out.absolute().parent.is_dir():
        raise InputError(f"--out {out}: folder {out.parent} does not exist")


def write_network(folder: Path, network: SiteNetwork) -> Entry:
    """Write a network's full graph into a site's folder, and return the network's entry in `site.json`."""
    announce(f"web: export {network.name}")
    model = network.model.cpu().eval()
    graph = make_streaming_graph(model) if has_streaming_graph(model) else model
    with tempfile.TemporaryDirectory() as temporary:
        path = Path(temporary) / "whole.onnx"
        export_full(graph, path, network.run, SPACE.name)
        played = _write_file(folder, f"networks/{network.key}.onnx.gz", path.read_bytes())
    rest = model.normalizer.rest.double().numpy()
    return {
        "key": network.key,
        "name": network.name,
        "run": network.run,
        "fps": FPS,
        "body": {  # head and wrists in the T-pose, the lowest joint's height, and the body height, metres
            "rest": (rest[list(TRACKED)] * SPACE.body).tolist(),
            "floor": float(rest[:, 1].min()),
            "height": compute_body_height(BodyTree(rest)),
            "eyes": EYES,
        },
        "play": played,
        "clips": list(network.clips),
        "remark": network.remark,
    }


def _write_file(folder: Path, address: str, content: bytes) -> str:
    """Write a file, and return its address on the site. Addresses with the suffix .gz are compressed."""
    path = folder / address
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(gzip.compress(content, 6, mtime=0) if path.suffix == ".gz" else content)
    return address


def _write_page(folder: Path) -> None:
    """Write the page's files with its security policy, and a service worker that lists all files and whose
    version changes with them."""
    page = resources.files("memmlp.live.web").joinpath("page")
    for package, names in {"memmlp.live.web": [path.name for path in page.iterdir()], **OTHER_PAGES}.items():
        for name in names:
            _write_file(folder, name, read_page_file(package, name))
    index = (folder / "index.html").read_text("utf-8")
    policy = build_security_policy(index, "'wasm-unsafe-eval'")
    _write_file(folder, "index.html", index.replace("POLICY", policy).encode())
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    digests = {file.relative_to(folder).as_posix(): file_digest(file) for file in files}
    version = hashlib.sha256(json.dumps(digests).encode()).hexdigest()[:16]
    others = [name for name in digests if name != "sw.js"]
    head = f"const VERSION = {json.dumps(version)};\nconst FILES = {json.dumps(others)};\n"
    _write_file(folder, "sw.js", head.encode() + (folder / "sw.js").read_bytes())
