"""Turns a folder of AMASS npz into a memory-mappable cache of 60 Hz frames with a manifest.

The sources are read twice, a clip at a time: once to learn which are sound and how long they are, so that the
split divides sound clips only and every array's size is known, and once to write the frames. The manifest is
written last: a cache without one is unfinished, and the next call makes it again.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from filelock import FileLock

from memmlp.common.errors import InputError
from memmlp.common.progress import track
from memmlp.motion.body import FPS, FRAME_DIM, load_rest_joints
from memmlp.motion.clip import Clip, Skipped, resample
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.preparing.splits import PARTS, Split, group_names
from memmlp.runs.recipes import RECIPES

FORMAT = 2  # number of the cache's format; a new one makes every cache again
FRAMES = 1  # number of a frame's content; a new one changes every digest, and so makes every run again
CHUNK = 4096  # frames turned into features at a time
MANIFEST = "manifest.json"
ITEM_BYTES = FRAME_DIM * 4


@dataclass(frozen=True)
class ClipFolder:
    """What a cache is made from.

    Attributes:
        root: folder of npz files, at any depth.
        split: assigns clips to train, val, test.
        body: "builtin" or the path of an SMPL-H model.npz.
        min_frames: clips with fewer frames at 60 Hz are skipped (42 leave T = 41 frames of input).
        strict: whether the first file that would be skipped raises InputError instead.
    """

    root: Path
    split: Split
    body: str = "builtin"
    min_frames: int = 42
    strict: bool = False


@dataclass(frozen=True)
class ClipRecord:
    """A clip in the cache.

    Attributes:
        name: path below the data root without suffix.
        split: "train", "val" or "test".
        group: name of the clip's group (`splits.group_names`); its own name where it belongs to none.
        start: its first frame in that split's array.
        length: its number of frames there.
        sha256: digest of the source file.
        fps: frame rate of the source, Hz.
        resampling: how it was brought to 60 Hz.
    """

    name: str
    split: str
    group: str
    start: int
    length: int
    sha256: str
    fps: float
    resampling: str


@dataclass(frozen=True)
class Survey:
    """What a folder of npz files holds.

    Attributes:
        clips: sound clips, without split and group yet.
        skipped: bad files.
        ignored: number of npz files without motion.
    """

    clips: tuple[ClipRecord, ...]
    skipped: tuple[Skipped, ...]
    ignored: int


@dataclass(frozen=True)
class Manifest:
    """What a cache holds; the content of `manifest.json`.

    Attributes:
        digest: sha256 over everything that determines the frames and their split. Groups are not in it, since
            training does not know them.
        request: sha256 over the settings and each source's path, size and time, by which a finished cache is
            recognised.
        body: "builtin", or the model file's name and a digest of its rest pose: "model.npz 0a1b2c3d".
        rest_joints: rest positions (22, 3), metres.
        split: the split's settings.
        min_frames: fewest frames at 60 Hz of a clip that is taken.
        clips: the clips, sorted by name.
        skipped: bad files.
        ignored: number of npz files without poses (shape.npz and the like).
        left_out: number of sound clips without a part in the split, by top-level folder.
        missing: entries of the split for which there is no file.
        totals: part -> clips, frames, hours.
        format: format number of the cache.
    """

    digest: str
    request: str
    body: str
    rest_joints: tuple[tuple[float, ...], ...]
    split: dict[str, Any]
    min_frames: int
    clips: tuple[ClipRecord, ...]
    skipped: tuple[Skipped, ...]
    ignored: int
    left_out: dict[str, int]
    missing: tuple[str, ...]
    totals: dict[str, dict[str, float]]
    format: int = FORMAT

    @classmethod
    def load(cls, out: Path) -> Manifest:
        """Load the manifest of a cache.

        Raises:
            InputError: if there is no finished cache of this format.
        """
        path = out / MANIFEST
        try:
            data = json.loads(path.read_text())
            if data["format"] != FORMAT:
                raise InputError(f"{path}: format {data['format']}, not {FORMAT}; prepare the data again")
            data["clips"] = tuple(ClipRecord(**clip) for clip in data["clips"])
            data["skipped"] = tuple(Skipped(**file) for file in data["skipped"])
            data["rest_joints"] = tuple(map(tuple, data["rest_joints"]))
            return cls(**{**data, "missing": tuple(data["missing"])})
        except FileNotFoundError as error:
            raise InputError(f"{out}: no finished cache; run memmlp data prepare") from error
        except (OSError, UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError) as error:
            raise InputError(f"{path}: not a cache's manifest ({error}); prepare the data again") from error

    @cached_property
    def rest(self) -> np.ndarray:
        """Rest positions (22, 3), metres, float64."""
        return np.array(self.rest_joints)

    @cached_property
    def groups(self) -> dict[str, str]:
        """clip name -> its group; statistics count a group once."""
        return {clip.name: clip.group for clip in self.clips}

    def part(self, split: str) -> list[ClipRecord]:
        """Return the clips of a split, in the order of its array."""
        return [clip for clip in self.clips if clip.split == split]


def prepare(source: ClipFolder, out: Path) -> Manifest:
    """Make the cache in `out`, or find it there finished; concurrent callers wait for one another.

    Raises:
        InputError: for a root without usable clips, an impossible split, a bad file under `strict`, a folder
            that cannot be written, or too small a disk.
    """
    source = ClipFolder(Path(source.root), source.split, str(source.body), source.min_frames, source.strict)
    if source.min_frames < 2:
        raise InputError(
            f"data.min_frames: {source.min_frames}; allowed: 2 or more (one frame has no velocity)"
        )
    rest = load_rest_joints(source.body)
    try:
        out.mkdir(parents=True, exist_ok=True)
        with FileLock(out / ".lock"):
            request = _request(source, rest)
            found = _finished(out, request)
            if found and not (source.strict and found.skipped):
                return found
            return _make(source, rest, request, out)
    except OSError as error:
        raise InputError(f"{out}: cannot write the cache there ({error.strerror or error})") from error


def finished(source: ClipFolder, out: Path) -> Manifest | None:
    """Return the manifest of a finished, up-to-date cache of the source in `out`, or None."""
    try:
        return _finished(out, _request(source, load_rest_joints(str(source.body))))
    except InputError:
        return None


def survey(root: Path, min_frames: int = 2, strict: bool = False) -> Survey:
    """Read every npz below a folder.

    Raises:
        InputError: if there are none, or at the first bad one if `strict`.
    """
    clips, skipped, ignored = [], [], 0
    for file in track(_sources(root), "reading"):
        path = root / file
        if _has_no_poses(path):
            ignored += 1
            continue
        try:
            clips.append(_inspect(path, file, min_frames))
        except InputError as error:
            if strict:
                raise
            skipped.append(Skipped(file, str(error).removeprefix(f"{path}: ")))
    return Survey(tuple(clips), tuple(skipped), ignored)


def _make(source: ClipFolder, rest: np.ndarray, request: str, out: Path) -> Manifest:
    """Read the sources, split them, and write the cache."""
    found = survey(source.root, source.min_frames, source.strict)
    if not found.clips:
        raise InputError(_no_clips(source.root, found))
    names = [clip.name for clip in found.clips]
    assignment = source.split.assign(names)
    clips = _place(found.clips, assignment.parts, group_names(names, source.split.groups))
    if not any(clip.split == "train" for clip in clips):
        raise InputError(f"{source.root}: no clip for training (data.root, data.split); give it other data")
    bad = {_name(file.file) for file in found.skipped}
    manifest = Manifest(
        digest=_digest(clips, rest, source.min_frames),
        request=request,
        body=_body(source.body, rest),
        rest_joints=tuple(map(tuple, rest.tolist())),
        split=source.split.describe(),
        min_frames=source.min_frames,
        clips=clips,
        skipped=found.skipped,
        ignored=found.ignored,
        left_out=_left_out(assignment.parts),
        missing=tuple(name for name in assignment.missing if name not in bad),
        totals={part: _total(clips, part) for part in PARTS},
    )
    _write(source, rest, manifest, out)
    return manifest


def _write(source: ClipFolder, rest: np.ndarray, manifest: Manifest, out: Path) -> None:
    """Write the arrays under temporary names, then rename them, then write the manifest."""
    (out / MANIFEST).unlink(missing_ok=True)
    frames = {part: int(manifest.totals[part]["frames"]) for part in PARTS}
    _check_space(out, sum(frames.values()) * ITEM_BYTES)
    with ExitStack() as stack:
        files = {part: stack.enter_context(open(out / f"{part}.npy.tmp", "wb")) for part in PARTS}
        for part, file in files.items():
            header = {"descr": "<f4", "fortran_order": False, "shape": (frames[part], FRAME_DIM)}
            np.lib.format.write_array_header_1_0(file, header)
        for record in track(manifest.clips, "writing"):
            clip, _, _ = _load(source.root / f"{record.name}.npz", record.name)
            for block in _frames(clip, rest):
                files[record.split].write(block.tobytes())
        for file in files.values():
            _sync(file)
    if _request(source, rest) != manifest.request:
        raise InputError(f"{source.root}: data.root changed while it was being prepared; run it again")
    for part in PARTS:
        os.replace(out / f"{part}.npy.tmp", out / f"{part}.npy")
    _write_manifest(manifest, out / MANIFEST)


def _write_manifest(manifest: Manifest, path: Path) -> None:
    temporary = path.with_name(path.name + ".tmp")
    with open(temporary, "wb") as file:
        file.write(json.dumps(asdict(manifest), indent=1).encode())
        _sync(file)
    os.replace(temporary, path)


def _sync(file: BinaryIO) -> None:
    file.flush()
    os.fsync(file.fileno())


def _frames(clip: Clip, rest: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the frames of a 60 Hz clip in blocks (<= CHUNK, 252), float32, computed in float64."""
    import torch  # takes seconds to import, and finding a finished cache does not need it

    from memmlp.motion.features import motion_frames

    poses, trans, joints = (torch.from_numpy(np.ascontiguousarray(x)) for x in (clip.poses, clip.trans, rest))
    for start in range(0, len(clip) - 1, CHUNK):
        block = slice(start, start + CHUNK + 1)  # one frame more than comes out, as the first has no velocity
        yield motion_frames(poses[block], trans[block], joints).numpy().astype("<f4")


def _sources(root: Path) -> list[str]:
    """Return the npz files below a folder, also through links: sorted paths relative to it."""
    if not root.is_dir():
        raise InputError(f"data.root: {root} is no folder; give it the folder with your npz clips")
    walk = os.walk(root, followlinks=True)
    files = (Path(folder, file) for folder, _, names in walk for file in names if file.endswith(".npz"))
    found = sorted(path.relative_to(root).as_posix() for path in files)
    if not found:
        raise InputError(f"data.root: no npz below {root}; make some with memmlp data synth or data import")
    return found


def _has_no_poses(path: Path) -> bool:
    """Return whether a file is a sound npz of something else than motion; only its directory is read."""
    try:
        with zipfile.ZipFile(path) as archive:
            return "poses.npy" not in archive.namelist()
    except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile):
        return False


def _inspect(path: Path, file: str, min_frames: int) -> ClipRecord:
    """Return the record of a sound clip, without split and start; raise InputError for any other file."""
    name = _name(file)
    clip, fps, how = _load(path, name)
    if len(clip) < min_frames:
        raise InputError(f"{path}: {len(clip)} frames at {FPS} Hz, fewer than {min_frames} (data.min_frames)")
    with open(path, "rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return ClipRecord(name, "", "", 0, len(clip) - 1, digest, fps, how)


def _load(path: Path, name: str) -> tuple[Clip, float, str]:
    """Read a clip, and return it at 60 Hz with its original frame rate and how it was resampled."""
    clip = read_clip(path, name)
    resampled, how = resample(clip)
    return resampled, clip.fps, how


def _name(file: str) -> str:
    return file.removesuffix(".npz")


def _body(body: str, rest: np.ndarray) -> str:
    """Name a body; a model's name includes a digest, since the model files of all bodies are named alike."""
    return "builtin" if body == "builtin" else f"{Path(body).name} {_hash(rest.tolist())[:8]}"


def _place(
    clips: Sequence[ClipRecord], parts: Mapping[str, str | None], groups: Mapping[str, str]
) -> tuple[ClipRecord, ...]:
    """Return the clips that have a part, each with its group and its position in that part's array."""
    ends = dict.fromkeys(PARTS, 0)
    placed = []
    for clip in clips:
        part = parts[clip.name]
        if part is not None:
            placed.append(replace(clip, split=part, group=groups[clip.name], start=ends[part]))
            ends[part] += clip.length
    return tuple(placed)


def _left_out(parts: Mapping[str, str | None]) -> dict[str, int]:
    """Count the clips without a part by top-level folder."""
    return dict(Counter(name.split("/")[0] for name, part in sorted(parts.items()) if part is None))


def _total(clips: Sequence[ClipRecord], part: str) -> dict[str, float]:
    lengths = [clip.length for clip in clips if clip.split == part]
    return {"clips": len(lengths), "frames": sum(lengths), "hours": sum(lengths) / FPS / 3600}


def _digest(clips: Sequence[ClipRecord], rest: np.ndarray, min_frames: int) -> str:
    sources = [(clip.name, clip.split, clip.sha256) for clip in clips]
    return _hash([FRAMES, min_frames, rest.tolist(), sources])


def _request(source: ClipFolder, rest: np.ndarray) -> str:
    """Return a digest of the settings and of each source's path, size and time, without opening any."""
    files = [(file, *_stamp(source.root / file)) for file in _sources(source.root)]
    code = [FORMAT, FRAMES, RECIPES["features"]]
    return _hash([*code, source.min_frames, rest.tolist(), source.split.describe(), files])


def _stamp(path: Path) -> tuple[int, int]:
    """Return size and time of a file; zeros for a dangling link, which reading will find and skip."""
    try:
        stat = path.stat()
    except OSError:
        return 0, 0
    return stat.st_size, stat.st_mtime_ns


def _hash(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def _finished(out: Path, request: str) -> Manifest | None:
    """Return the manifest in `out` if it answers the request and its arrays are complete, else None."""
    try:
        manifest = Manifest.load(out)
        whole = all(_array_frames(out, part) == manifest.totals[part]["frames"] for part in PARTS)
    except (InputError, OSError, ValueError, KeyError):
        return None
    return manifest if whole and manifest.request == request else None


def _array_frames(out: Path, part: str) -> int:
    """Return the frames in a part's array; raise ValueError if its size does not agree with its header."""
    return len(np.lib.format.open_memmap(out / f"{part}.npy", mode="r"))


def _check_space(out: Path, needed: int) -> None:
    free = shutil.disk_usage(out).free
    if needed > free:
        raise InputError(f"{out}: the cache needs {needed / 1e9:.1f} GB, and {free / 1e9:.1f} GB are free")


def _no_clips(root: Path, found: Survey) -> str:
    first = f"; the first: {found.skipped[0].file}: {found.skipped[0].reason}" if found.skipped else ""
    return (
        f"data.root: no usable clip below {root} ({len(found.skipped)} bad, {found.ignored} without poses"
        f"{first}); give it AMASS npz files"
    )
