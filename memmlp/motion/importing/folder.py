"""Imports a folder of BVH files as AMASS npz, with a record of what came from what, or nothing at all."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.progress import progress_bar
from memmlp.motion.body import load_rest_joints
from memmlp.motion.clip import FRAME_RATE_RANGE, Skipped
from memmlp.motion.formats.bvh import Bvh, find_bvh, read_bvh
from memmlp.motion.formats.npz import write_clip
from memmlp.motion.importing.retarget import retarget
from memmlp.motion.importing.skeleton import SkeletonMap, find_skeleton, is_number, load_skeleton

RECORD = "import.json"
HEADER = "the header's"


@dataclass(frozen=True)
class Imported:
    """One imported clip.

    Attributes:
        source: the BVH file's path below its folder.
        sha256: digest of that file.
        clip: the npz file's path below its folder.
        skeleton: name of the skeleton map.
        frames: number of frames.
        header_fps: frame rate that the file's header tells, Hz.
        fps: frame rate of the clip, Hz.
        fps_reason: where that rate is from.
    """

    source: str
    sha256: str
    clip: str
    skeleton: str
    frames: int
    header_fps: float
    fps: float
    fps_reason: str


@dataclass(frozen=True)
class ImportReport:
    """What an import did.

    Attributes:
        clips: the clips that it wrote.
        notes: one line for each folder whose header rate it corrected.
        skipped: the files that it skipped.
    """

    clips: tuple[Imported, ...]
    notes: tuple[str, ...]
    skipped: tuple[Skipped, ...]


def import_folder(
    source: Path,
    out: Path,
    *,
    skeleton: str | None = None,
    fps: Mapping[str, float] = {},
    body: str = "builtin",
    strict: bool = False,
) -> ImportReport:
    """Write each BVH file of a folder, or a single one, as out/<its path>.npz, and out/import.json about it.

    Args:
        source: folder or file.
        out: folder; it must hold no clips other than this import's.
        skeleton: a shipped map or the path of one; by default each file's joints decide.
        fps: true frame rates, Hz, by folder below source ("" for all); they override the map's and the
            header's.
        body: `builtin`, or an SMPL-H model.npz.
        strict: whether a bad file raises; otherwise it is skipped and reported.

    Raises:
        InputError: with nothing written, if there are no files, several of the same name, a rate that fits no
            folder, clips of another import in `out`, or no file that could be imported; also if `out` cannot
            be written.
    """
    files = find_bvh(source)
    _check_import(files, out, fps)
    rest, clips, skipped = load_rest_joints(body), [], []
    chosen = None if skeleton is None else load_skeleton(skeleton)
    with _staging(out) as staging:
        for relative, path in progress_bar(files.items(), "import", len(files)):
            try:
                clips.append(_import_file(path, relative, Path(staging), chosen, fps, rest))
            except InputError as error:
                if strict or len(files) == 1:
                    raise
                source_name = relative.as_posix()
                skipped.append(Skipped(source_name, str(error).replace(str(path), source_name)))
        if not clips:
            raise InputError(f"{source}: no usable BVH file of {len(files)}; the first: {skipped[0].reason}")
        notes = dict.fromkeys(_note(clip) for clip in clips if clip.fps != clip.header_fps)
        report = ImportReport(tuple(clips), tuple(notes), tuple(skipped))
        _publish(Path(staging), out, report, Path(body).name)
    return report


def _npz(relative: Path) -> Path:
    """Return a clip's path below `out`, given its source's path below the source folder."""
    return relative.with_suffix(".npz")


def _check_import(files: Mapping[Path, Path], out: Path, fps: Mapping[str, float]) -> None:
    """Raise InputError for two sources of one clip, foreign clips in `out`, or rates for no folder."""
    npz, count = Counter(_npz(relative) for relative in files).most_common(1)[0]
    if count > 1:
        raise InputError(f"{npz.with_suffix('').as_posix()}: {count} BVH files of this name; allowed: one")
    foreign = sorted({path.relative_to(out) for path in out.rglob("*.npz")} - {_npz(path) for path in files})
    if foreign or (out.exists() and not out.is_dir()):
        wrong = f"has other clips, such as {foreign[0].as_posix()}" if foreign else "is a file"
        raise InputError(f"{out}: {wrong}; allowed: a new folder, or that of the same import")
    folders = sorted({_key(folder) for relative in files for folder in relative.parents})
    for folder, rate in fps.items():
        if folder not in folders or not is_number(rate, *FRAME_RATE_RANGE):
            allowed = f"1 to 1000 Hz for {', '.join(map(repr, folders))} ('' is all)"
            raise InputError(f"fps: {rate!r} for {folder!r}; allowed: {allowed}")


def _key(folder: Path) -> str:
    """Return a folder below source as `fps` names it."""
    return "" if folder == Path() else folder.as_posix()


def _staging(out: Path) -> tempfile.TemporaryDirectory:
    """Make a folder beside `out`, in which an import grows until it is complete."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        return tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}-")
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); allowed: a new folder") from error


def _import_file(
    path: Path,
    relative: Path,
    folder: Path,
    skeleton: SkeletonMap | None,
    fps: Mapping[str, float],
    rest: np.ndarray,
) -> Imported:
    """Write one clip below the staging folder."""
    bvh = read_bvh(path)
    chosen = skeleton or find_skeleton(bvh)
    rate, reason = _rate(bvh, chosen, relative, fps)
    name = relative.with_suffix("").as_posix()
    clip = retarget(bvh, chosen, rest, name=name, fps=rate)
    write_clip(folder / _npz(relative), clip)
    return Imported(
        source=relative.as_posix(),
        sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        clip=_npz(relative).as_posix(),
        skeleton=chosen.name,
        frames=len(clip),
        header_fps=bvh.fps,
        fps=rate,
        fps_reason=reason,
    )


def _rate(bvh: Bvh, skeleton: SkeletonMap, relative: Path, fps: Mapping[str, float]) -> tuple[float, str]:
    """Return the true frame rate and where it is from.

    It is the one given for the nearest folder, or known from the map, or the header's.
    """
    for folder in relative.parents:
        if _key(folder) in fps:
            return float(fps[_key(folder)]), f"given for {_key(folder) or 'all'}"
    folder_name = bvh.path.resolve().parent.name
    known = float(skeleton.rates.get(folder_name, bvh.fps))
    if known != bvh.fps:
        return known, f"known of {folder_name} in {skeleton.name}"
    return bvh.fps, HEADER


def _note(clip: Imported) -> str:
    """Describe a folder's corrected rate in one line."""
    folder = Path(clip.source).parent.as_posix()
    return f"{folder}: {clip.fps:g} Hz, {clip.fps_reason}; the header says {clip.header_fps:g} Hz"


def _publish(staging: Path, out: Path, report: ImportReport, body: str) -> None:
    """Move clips and record from staging to `out`, and remove earlier clips of the files skipped now."""
    record = {"body": body, **asdict(report)}
    (staging / RECORD).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    try:
        for name in [*(clip.clip for clip in report.clips), RECORD]:
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.move(staging / name, out / name)
        for skipped in report.skipped:
            (out / _npz(Path(skipped.file))).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(
            f"{out}: cannot be written ({error.strerror}); allowed: a folder to write to"
        ) from error
