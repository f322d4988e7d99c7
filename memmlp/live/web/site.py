"""A site as a folder of static files: the page, packages, networks, clips, and a service worker."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from torch import Tensor

from memmlp import __version__
from memmlp.common.errors import InputError
from memmlp.common.files import file_digest, now, read_json
from memmlp.common.lease import publish, temporary
from memmlp.deploy.latency import yardstick
from memmlp.live.session.loop import TOP
from memmlp.live.web.clips import SiteClip, write_clips
from memmlp.live.web.networks import SiteNetwork, Writer
from memmlp.live.web.packages import write_packages
from memmlp.motion.body import JOINTS
from memmlp.motion.limb_shapes import HEAT, LIMBS

SHARED = {
    "memmlp.live.session": ("stage.js", "history.js"),
    "memmlp.common": ("theme.js", "dom.js", "style.css"),
}
"""Files of other pages of the package that a site uses, too."""
ABOUT = "site.json"


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
            _replace(out, unfinished)
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)
        return total

    def _fill(self, folder: Path) -> None:
        versions = write_packages(folder, self.webgpu)
        _copy(folder)
        writer = Writer(folder, self.calibration, self.base is not None)
        about: dict[str, Any] = {
            "memmlp": __version__,
            "made": now(),
            "packages": versions,
            "backends": ["wasm", "webgpu"] if self.webgpu else ["wasm"],
            "networks": [writer.write(network) for network in self.networks],
            "clips": write_clips(self.clips, folder),
            "limbs": [{"start": a, "end": b, "radii": radii, "tip": tip} for a, b, radii, tip in LIMBS],
            "joints": JOINTS,
            "heat": HEAT,
            "top": TOP,
        }
        if self.base is not None:
            about |= {
                "base": writer.write(self.base),
                "yardstick": writer.weightless("yardstick", yardstick()),
            }
        (folder / ABOUT).write_text(json.dumps(about, separators=(",", ":")) + "\n", encoding="utf-8")
        _worker(folder)


def check_place(out: Path) -> None:
    """Raise InputError if no site may be written there: over other content, or in place of a file."""
    if out.exists() and not out.is_dir():
        raise InputError(f"--out {out}: a file; allowed is a new folder, or a site that is to be replaced")
    if out.is_dir() and any(out.iterdir()) and "packages" not in read_json(out / ABOUT):
        raise InputError(
            f"--out {out}: has something else in it; allowed is a new folder, or an earlier site"
        )
    if not out.absolute().parent.is_dir():
        raise InputError(f"--out {out}: there is no folder {out.parent}")


def _replace(out: Path, unfinished: Path) -> None:
    """Put a finished site in its place; an earlier site is moved away first, and deleted at the end."""
    earlier = temporary(out)
    if out.exists():
        out.rename(earlier)
    publish(unfinished, out)
    shutil.rmtree(earlier, ignore_errors=True)


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def _copy(folder: Path) -> None:
    """Copy the page's own files, and the files that it shares with other pages."""
    own = resources.files("memmlp.live.web").joinpath("page")
    for path in own.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    for package, names in SHARED.items():
        for name in names:
            (folder / name).write_bytes(resources.files(package).joinpath("page", name).read_bytes())
    page = folder / "index.html"
    page.write_text(page.read_text(encoding="utf-8").replace("POLICY", _policy(page)), encoding="utf-8")


def _policy(page: Path) -> str:
    """Return the Content-Security-Policy: no other hosts; scripts are files, or the import map."""
    inline = re.search(r'<script type="importmap">(.*?)</script>', page.read_text("utf-8"), re.DOTALL)
    assert inline is not None
    digest = base64.b64encode(hashlib.sha256(inline[1].encode()).digest()).decode()
    return (
        f"default-src 'none'; script-src 'self' 'wasm-unsafe-eval' 'sha256-{digest}'; worker-src 'self'; "
        "style-src 'self' 'unsafe-inline'; img-src 'self' data:; connect-src 'self'; base-uri 'none'; "
        "form-action 'none'"
    )


def _worker(folder: Path) -> None:
    """Write the list of files into the service worker, and a version that changes with any of them."""
    path = folder / "sw.js"
    digests = {str(file.relative_to(folder).as_posix()): file_digest(file) for file in _files(folder)}
    version = hashlib.sha256(json.dumps(digests).encode()).hexdigest()[:16]
    names = [name for name in digests if name != path.name]
    head = f"const VERSION = {json.dumps(version)};\nconst FILES = {json.dumps(names)};\n"
    path.write_text(head + path.read_text(encoding="utf-8"), encoding="utf-8")
