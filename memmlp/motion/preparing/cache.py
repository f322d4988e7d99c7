"""Converts a folder of AMASS npz files to a memory-mappable cache of 60 Hz frames with a manifest.

The files are read twice, one clip at a time. The first pass finds the valid clips and their lengths, which
the split and the array sizes depend on. The second pass writes the frames. The manifest is written last: a
cache without a manifest is unfinished, and the next call prepares it again.
"""

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from memmlp.common.errors import InputError, is_disk_error
from memmlp.common.files import digest
from memmlp.common.lease import Lock, check_owner, publish, temporary_path
from memmlp.common.progress import progress_bar
from memmlp.motion.body import FRAME_DIM, check_imported_body, format_body_name, load_rest_joints
from memmlp.motion.clip import INTERPOLATED, LINES, SPLINES, Clip, describe_first, resample
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.preparing.find_clips import NamedFolders, Root, find_clips
from memmlp.motion.preparing.manifest import FORMAT, MANIFEST, PARTS, ClipRecord, Manifest
from memmlp.motion.preparing.splits import Split
from memmlp.runs.identity import VERSIONS

FRAMES_VERSION = 1  # version of the frames' content; a new version changes all digests and repeats all runs
CHUNK = 4096  # maximum number of frames that are converted at a time


@dataclass(frozen=True)
class ClipFolder:
    """The source of a cache: `root` is a folder with npz files at any depth, or several named folders; `body`
    is "builtin" or an SMPL-H model.npz. Clips with fewer frames at 60 Hz than `min_frames` are skipped; 42
    frames give T = 41 inputs. A bad file is skipped, or with `strict` raises InputError. `interpolation` is
    SPLINES or LINES."""

    root: Root
    split: Split
    body: str = "builtin"
    min_frames: int = 42
    strict: bool = False
    interpolation: str = SPLINES


def prepare_cache(source: ClipFolder, out: Path, overwrite: bool = True) -> Manifest:
    """Prepare the cache in the folder `out`, unless it is current. Only one process does so at a time. Raises
    InputError if the root has no usable clips, the split is impossible, the folder cannot be written, or a
    file is bad and `strict` is set; OSError if the disk is full or read-only. Without `overwrite`, raises
    InputError also if the folder has other files, or the cache of other frames."""
    rest = load_rest_joints(source.body)
    clips = [source.root / file for file in find_clips(source.root).files]
    check_imported_body(clips, rest, f"data.body={source.body}")
    try:
        out.mkdir(parents=True, exist_ok=True)
        if not overwrite:
            _check_foreign_files(out)
        with Lock(out).hold():
            request = _compute_request_digest(source, rest)
            manifest = _load_if_current(out, request)
            if manifest and not (source.strict and manifest.skipped):
                return manifest
            manifest = _plan_cache(source, rest, request)
            if not overwrite:
                _check_same_frames(out, manifest)
            _write_cache(source, rest, manifest, out)
            return manifest
    except OSError as error:
        if is_disk_error(error):
            error.filename = error.filename or str(out)
            raise
        raise InputError(f"{out}: the cache cannot be written ({error.strerror or error})") from error


def _check_foreign_files(out: Path) -> None:
    names = sorted(path.name for path in out.iterdir())
    own = (MANIFEST, *(f"{part}.npy" for part in PARTS)) if Lock(out).list_claims() else ()
    if foreign := [name for name in names if not name.startswith(".") and name not in own]:
        raise InputError(f"{out}: has other files, such as {foreign[0]}; must be a new or empty folder")


def _check_same_frames(out: Path, manifest: Manifest) -> None:
    try:
        same = Manifest.load(out).digest == manifest.digest
    except InputError:  # unfinished, damaged, or of another format
        return
    if not same:
        raise InputError(f"{out}: has a cache of other data or settings; must be a new or empty folder")


def load_finished_cache(source: ClipFolder, out: Path) -> Manifest | None:
    """Load the manifest of the source's cache in `out`; None if the cache is unfinished or outdated."""
    try:
        return _load_if_current(out, _compute_request_digest(source, load_rest_joints(source.body)))
    except InputError:
        return None


def _plan_cache(source: ClipFolder, rest: np.ndarray, request: str) -> Manifest:
    from memmlp.motion.preparing.duplicates import assign_parts  # scipy takes 0.4 s to import
    from memmlp.motion.preparing.survey import survey_folder

    summary, split = survey_folder(source.root, source.min_frames, source.strict), source.split
    if not summary.clips:
        bad = f"{len(summary.skipped)} bad files{describe_first(summary.skipped)}"
        raise InputError(f"data.root={source.root}: no usable clip ({bad}); expected AMASS npz files")
    names = [clip.name for clip in summary.clips]
    parts, groups, duplicates = assign_parts(split, summary.clips)
    files = [*names, *summary.short, *summary.damaged_files]
    split.check_groups([name for name, part in parts.items() if part], files)
    clips = _assign_clips_to_splits(summary.clips, parts, groups)
    if not any(clip.split == "train" for clip in clips):
        raise InputError(f"data.root={source.root}: no clip for training; check data.split")
    left_out = [n for n, part in sorted(parts.items()) if part is None and n not in duplicates]
    interpolated = source.interpolation != LINES and any(clip.resampling == INTERPOLATED for clip in clips)
    frames = [(clip.name, clip.split, clip.sha256) for clip in clips]
    ingredients = [FRAMES_VERSION, source.min_frames, rest.tolist(), frames]
    return Manifest(
        digest=digest([*ingredients, *([source.interpolation] if interpolated else [])]),
        request=request,
        body=format_body_name(source.body, rest),
        rest_joints=tuple(map(tuple, rest.tolist())),
        split=split.describe(),
        min_frames=source.min_frames,
        interpolation=source.interpolation,
        clips=clips,
        skipped=summary.skipped,
        left_out=dict(Counter(name.split("/")[0] for name in left_out)),
        listed=dict(split.entry_counts),
        missing=split.find_missing_entries([*names, *summary.short]),
        duplicates=duplicates,
        unusual=summary.unusual,
        sources=tuple(source.root.sources) if isinstance(source.root, NamedFolders) else (),
    )


def _assign_clips_to_splits(
    clips: Sequence[ClipRecord], parts: Mapping[str, str | None], groups: Mapping[str, str]
) -> tuple[ClipRecord, ...]:
    """Return the clips of all splits, with their groups and their positions in the arrays."""
    ends = dict.fromkeys(PARTS, 0)
    assigned = []
    for clip in clips:
        part = parts[clip.name]
        if part is not None:
            assigned.append(replace(clip, split=part, group=groups[clip.name], start=ends[part]))
            ends[part] += clip.length
    return tuple(assigned)


def _write_cache(source: ClipFolder, rest: np.ndarray, manifest: Manifest, out: Path) -> None:
    """Write the arrays to temporary files, rename these files, then write the manifest."""
    check_owner(out)
    (out / MANIFEST).unlink(missing_ok=True)
    unfinished = {part: temporary_path(out / f"{part}.npy") for part in PARTS}
    try:
        _write_frames(source, rest, manifest, unfinished)
        if _compute_request_digest(source, rest) != manifest.request:
            raise InputError(f"data.root={source.root}: changed during preparation; run the command again")
        for part, path in unfinished.items():
            publish(path, out / f"{part}.npy")
    finally:
        for path in unfinished.values():
            path.unlink(missing_ok=True)
    manifest.write(out)


def _write_frames(
    source: ClipFolder, rest: np.ndarray, manifest: Manifest, paths: Mapping[str, Path]
) -> None:
    from memmlp.motion.geometry import limit_to_one_thread  # imports torch

    with ExitStack() as stack:
        stack.enter_context(limit_to_one_thread())
        files = {part: stack.enter_context(open(path, "wb")) for part, path in paths.items()}
        for part, file in files.items():
            shape = (manifest.totals[part].frames, FRAME_DIM)
            header = {"descr": "<f4", "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(file, header)
        for record in progress_bar(manifest.clips, "writing"):
            clip = read_clip(source.root / record.file, record.name)
            for block in compute_frame_blocks(resample(clip, interpolation=source.interpolation)[0], rest):
                files[record.split].write(block.tobytes())
        for file in files.values():
            file.flush()
            os.fsync(file.fileno())


def compute_frame_blocks(clip: Clip, rest: np.ndarray) -> Iterator[np.ndarray]:
    """Yield a 60 Hz clip's frames in blocks (<= CHUNK, 252): float32, computed in float64."""
    import torch  # takes seconds to import; a finished cache does not need it

    from memmlp.motion.geometry import compute_motion_frames

    poses, trans, joints = (torch.from_numpy(np.ascontiguousarray(x)) for x in (clip.poses, clip.trans, rest))
    for start in range(0, len(clip) - 1, CHUNK):
        block = slice(start, start + CHUNK + 1)  # one extra frame, because the first has no velocity
        yield compute_motion_frames(poses[block], trans[block], joints).numpy().astype("<f4")


def _compute_request_digest(source: ClipFolder, rest: np.ndarray) -> str:
    """Return a digest of the settings and of each file's path, size and times. No file is opened."""
    files = [(file, *_read_stamp(source.root / file)) for file in find_clips(source.root).files]
    code = [FORMAT, FRAMES_VERSION, VERSIONS["features"]]
    settings = [source.min_frames, source.interpolation, rest.tolist(), source.split.describe()]
    return digest([*code, *settings, files])


def _read_stamp(path: Path) -> tuple[int, int, int]:
    """Return size, modification time and change time of a file; zeros for a dangling link. Archives can set
    the modification time, but not the change time."""
    try:
        stat = path.stat()
    except OSError:
        return 0, 0, 0
    return stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns


def _load_if_current(out: Path, request: str) -> Manifest | None:
    """Load the manifest in `out`; None unless it matches the request and all arrays are complete."""
    try:
        manifest = Manifest.load(out)
        # Opening an array raises ValueError if its size contradicts its header.
        lengths = {part: len(np.lib.format.open_memmap(out / f"{part}.npy", mode="r")) for part in PARTS}
        whole = all(lengths[part] == manifest.totals[part].frames for part in PARTS)
    except (InputError, OSError, ValueError, KeyError):
        return None
    return manifest if whole and manifest.request == request else None
