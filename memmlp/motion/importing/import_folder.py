"""Imports a folder of recordings as AMASS npz, with a record of the sources, or verifies such an import."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.progress import progress_bar
from memmlp.motion.body import load_rest_joints
from memmlp.motion.clip import FRAME_RATE_RANGE, Skipped, is_known_rate, nearest_rate
from memmlp.motion.formats.npz import read_clip, write_clip
from memmlp.motion.formats.recording import Recording
from memmlp.motion.geometry import clip_kinematics, one_thread
from memmlp.motion.importing.convert import AUTO, JUMP, convert, first_step, lower_clip
from memmlp.motion.importing.fidelity import FEET_STAY, Fidelity, compare, floor_faults
from memmlp.motion.importing.recordings import (
    HEADER,
    SIDECAR,
    find_recordings,
    folder_key,
    read_recording,
    states_rate,
    true_rate,
)
from memmlp.motion.importing.retarget import STRAIGHTEST
from memmlp.motion.importing.skeleton_map import SkeletonMap, find_skeleton, is_number, load_skeleton
from memmlp.motion.preparing.groups import Grouping
from memmlp.motion.preparing.imported_body import RECORD, body_record


@dataclass(frozen=True)
class Imported:
    """One imported clip.

    Attributes:
        source: the file's path below its folder.
        sha256: digest of that file.
        clip: the npz file's path below its folder.
        skeleton: name of the skeleton map.
        unit: the file's unit, metres.
        up: the file's up axis, `y` or `z`.
        stance: a description of the pose from which the skeleton was read.
        frames: number of frames.
        header_fps: frame rate in the file's header, Hz.
        fps: frame rate of the clip, Hz.
        fps_reason: a description of the rate's origin.
        floor: height of the floor that was subtracted, metres at the body's size; None if none was found or
            asked for.
        scale: the body's size, as a multiple of the file's.
        first_step: the distance of frame 0 from frame 1, in multiples of other frames' steps
            (`convert.first_step`); None where the map leaves frame 0 of the file out.
        faults: the clip's faults, one sentence each (`fidelity.compare`).
    """

    source: str
    sha256: str
    clip: str
    skeleton: str
    unit: float
    up: str
    stance: str
    frames: int
    header_fps: float
    fps: float
    fps_reason: str
    floor: float | None
    scale: float
    first_step: float | None
    faults: tuple[str, ...]


@dataclass(frozen=True)
class ImportReport:
    """The result of an import.

    Attributes:
        clips: the clips that were written.
        notes: remarks on the clips for the user: corrected frame rates, notes of the maps, and the like.
        skipped: the files that were skipped.
    """

    clips: tuple[Imported, ...]
    notes: tuple[str, ...]
    skipped: tuple[Skipped, ...]


@dataclass(frozen=True)
class ImportSettings:
    """The settings of an import.

    Attributes:
        skeleton: the name of a shipped map, or the path of a map; None lets each file's joints decide.
        fps: true frame rates, Hz, by folder below the source ("" for all); they override known rates of
            files, files beside the data, and headers.
        body: `builtin`, or an SMPL-H model.npz.
        floor: `auto`: the lowest stable contact of the feet is at 0; `none`: left as the file has it; or the
            floor's height in the files, metres.
        takes: patterns (regular expressions) of clips' names, which are paths without suffix; clips that
            match a pattern with the same captured groups were recorded together, and share a floor.
        strict: whether a bad file raises; otherwise it is skipped and reported.
        sound: whether a clip with faults is skipped, too; otherwise it is written and its faults are
            reported.
        up: the files' up axis, `y` or `z`; None leaves it to the map.
    """

    skeleton: str | None = None
    fps: Mapping[str, float] = field(default_factory=dict)
    body: str = "builtin"
    floor: str | float = AUTO
    takes: Sequence[str] = ()
    strict: bool = False
    sound: bool = False
    up: str | None = None


def import_folder(source: Path, out: Path, how: ImportSettings | None = None) -> ImportReport:
    """Write each file of a folder, or a single file, as out/<its path>.npz, and a record as out/import.json.

    Args:
        source: folder or file.
        out: folder; it must not hold other clips than this import's.
        how: the settings.

    Raises:
        InputError: with nothing written, if there are no files, several of the same name, a rate that fits no
            folder, clips of another import in `out`, or no file that could be imported; also if `out` cannot
            be written.
    """
    how, files = how or ImportSettings(), find_recordings(source)
    _check_import(files, out, how)
    rest, clips, skipped = load_rest_joints(how.body), [], []
    chosen = None if how.skeleton is None else load_skeleton(how.skeleton)
    names = {relative.as_posix(): relative.with_suffix("").as_posix() for relative in files}
    takes = Grouping(how.takes).names(names)
    maps: dict[str, SkeletonMap] = {}
    with _make_staging(out) as staging, one_thread():
        folder = Path(staging) / "clips"
        folder.mkdir()
        for relative, path in progress_bar(files.items(), "import", len(files)):
            try:
                recording = read_recording(path)
                skeleton = find_skeleton(recording, chosen).with_up(how.up)
                clips.append(_import_file(recording, relative, folder, skeleton, how, rest, source))
                maps[skeleton.name] = skeleton
            except InputError as error:
                if how.strict or len(files) == 1:
                    raise
                skipped.append(Skipped(relative.as_posix(), str(error).removeprefix(f"{path}: ")))
        clips = _share_floors(clips, takes, folder, rest)
        for clip in [clip for clip in clips if how.sound and clip.faults]:
            unsound = _describe_unsound(clip.faults)
            if how.strict:
                raise InputError(f"{files[Path(clip.source)]}: {unsound}")
            skipped.append(Skipped(clip.source, unsound))
            (folder / clip.clip).unlink()
            clips.remove(clip)
        if not clips:
            first = f"the first: {skipped[0].file}: {skipped[0].reason}"
            raise InputError(f"{source}: no usable file of {len(files)}; {first}")
        notes = (*_take_notes(names, how.takes), *_notes(clips, maps, how))
        report = ImportReport(tuple(clips), notes, tuple(skipped))
        _publish(folder, out, report, body_record(how.body, rest))
    return report


def verify_folder(
    source: Path, *, skeleton: str | None = None, body: str = "builtin", up: str | None = None
) -> Iterator[Fidelity | Skipped]:
    """Import each file of a folder, or a single one, on trial, and compare the npz with the file.

    Args:
        source: folder or file.
        skeleton: the name of a shipped map, or the path of a map; by default the files' joints decide.
        body: `builtin`, or an SMPL-H model.npz.
        up: the files' up axis, `y` or `z`; None leaves it to the map.

    Yields:
        The comparison, or the reason why a file cannot be imported.

    Raises:
        InputError: if there is no file, or no such skeleton or body.
    """
    files, rest = find_recordings(source), load_rest_joints(body)
    top = source if source.is_dir() else source.parent
    chosen = None if skeleton is None else load_skeleton(skeleton)
    for relative, path in progress_bar(files.items(), "verify", len(files)):
        try:
            recording, name = read_recording(path), relative.as_posix()
            fitting = find_skeleton(recording, chosen).with_up(up)
            fps = true_rate(recording.fps, relative, path.read_bytes(), top, {}).fps
            with one_thread(), tempfile.TemporaryDirectory() as folder:
                converted = convert(recording, fitting, rest, name=name, fps=fps)
                write_clip(Path(folder) / "clip.npz", converted.clip)
                clip = read_clip(Path(folder) / "clip.npz", name)
            yield compare(clip, converted.motion, rest, fitting.name)
        except InputError as error:
            yield Skipped(relative.as_posix(), str(error).replace(f"{path}: ", ""))


def _check_import(files: Mapping[Path, Path], out: Path, how: ImportSettings) -> None:
    """Raise InputError for two sources of one clip, foreign clips in `out`, or wrong takes or rates."""
    npz, count = Counter(relative.with_suffix(".npz") for relative in files).most_common(1)[0]
    if count > 1:
        raise InputError(f"{npz.with_suffix('').as_posix()}: {count} recordings of this name; expected one")
    own = {path.with_suffix(".npz") for path in files}
    foreign = sorted({path.relative_to(out) for path in out.rglob("*.npz")} - own)
    if foreign or (out.exists() and not out.is_dir()):
        problem = f"has other clips, such as {foreign[0].as_posix()}" if foreign else "is a file"
        raise InputError(f"{out}: {problem}; expected a new folder, or that of the same import")
    for pattern in how.takes:
        try:
            re.compile(pattern)
        except re.error as error:
            raise InputError(f"take={pattern!r}: must be a regular expression ({error})") from error
    folders = sorted({folder_key(folder) for relative in files for folder in relative.parents})
    for folder, rate in how.fps.items():
        if folder not in folders or not is_number(rate, *FRAME_RATE_RANGE):
            known = ", ".join(map(repr, folders))
            raise InputError(f"fps={folder}={rate!r}: must be 1 to 1000 Hz for one of {known} ('' is all)")


def _make_staging(out: Path) -> tempfile.TemporaryDirectory:
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        return tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}-")
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror})") from error


def _import_file(
    recording: Recording,
    relative: Path,
    folder: Path,
    skeleton: SkeletonMap,
    how: ImportSettings,
    rest: np.ndarray,
    source: Path,
) -> Imported:
    content = recording.path.read_bytes()
    top = source if source.is_dir() else source.parent
    rate = true_rate(recording.fps, relative, content, top, how.fps)
    if rate.reason == HEADER and not states_rate(recording.path):
        raise InputError(
            f"{recording.path}: the format does not state a frame rate; give --fps HZ "
            f"({recording.fps:g} for the published files), or {SIDECAR}"
        )
    name = relative.with_suffix("").as_posix()
    converted = convert(recording, skeleton, rest, name=name, fps=rate.fps, floor=how.floor)
    if how.sound and converted.fidelity.faults:
        raise InputError(f"{recording.path}: {_describe_unsound(converted.fidelity.faults)}")
    write_clip(folder / relative.with_suffix(".npz"), converted.clip)
    return Imported(
        source=relative.as_posix(),
        sha256=hashlib.sha256(content).hexdigest(),
        clip=relative.with_suffix(".npz").as_posix(),
        skeleton=skeleton.name,
        unit=converted.unit,
        up=converted.up,
        stance=converted.stance,
        frames=len(converted.clip),
        header_fps=recording.fps,
        fps=rate.fps,
        fps_reason=rate.reason,
        floor=converted.floor,
        scale=converted.scale,
        first_step=None if skeleton.calibration_frame else first_step(recording),
        faults=converted.fidelity.faults,
    )


def _describe_unsound(faults: Sequence[str]) -> str:
    return f"{'; '.join(faults)}; --sound expects clips without faults"


def _share_floors(
    clips: Sequence[Imported], takes: Mapping[str, str], staging: Path, rest: np.ndarray
) -> list[Imported]:
    """Lower the clips of a take by the take's lowest floor, instead of each clip by its own.

    The floors are compared at the size that the files have. Two persons of a take stand on the same floor
    there, but no longer once each was scaled to the body by a factor of his or her own. Whether a clip's feet
    stand on the floor is checked again.
    """
    clips = list(clips)
    floors: dict[str, float] = {}
    for clip in clips:
        if clip.floor is not None:
            height = clip.floor / clip.scale
            floors[takes[clip.source]] = min(height, floors.get(takes[clip.source], height))
    for index, clip in enumerate(clips):
        lowest = floors.get(takes[clip.source])
        if lowest is not None and (clip.floor is None or lowest != clip.floor / clip.scale):
            floor = lowest * clip.scale
            path = staging / clip.clip
            motion = lower_clip(read_clip(path, clip.clip), floor - (clip.floor or 0.0))
            write_clip(path, motion)
            others = (fault for fault in clip.faults if not fault.startswith(FEET_STAY))
            faults = (*others, *floor_faults(clip_kinematics(motion, rest)[1]))
            clips[index] = replace(clip, floor=floor, faults=faults)
    return clips


def _publish(staging: Path, out: Path, report: ImportReport, body: Mapping[str, str]) -> None:
    """Move clips and record from staging to `out`, and remove earlier clips of the files skipped now.

    A new folder `out` appears with all files at once. In the folder of an earlier import, the old record is
    removed first and the new one is written last, so a folder without a record may hold clips of two imports.
    """
    record = {**body, **asdict(report)}
    (staging / RECORD).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    try:
        if not out.exists():
            staging.rename(out)
            return
        (out / RECORD).unlink(missing_ok=True)
        for name in [*(clip.clip for clip in report.clips), RECORD]:
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.move(staging / name, out / name)
        for skipped in report.skipped:
            (out / Path(skipped.file).with_suffix(".npz")).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror})") from error


# Notes for the user, one line each


def _take_notes(names: Mapping[str, str], takes: Sequence[str]) -> Iterator[str]:
    for pattern in takes:
        if len(set(Grouping([pattern]).names(names).values())) == len(names):
            yield f"--take {pattern}: ties no two clips; it sees names such as {min(names.values())}"


def _notes(clips: Sequence[Imported], maps: Mapping[str, SkeletonMap], how: ImportSettings) -> Iterator[str]:
    corrected: dict[str, list[str]] = {}
    odd: dict[float, list[str]] = {}
    for clip in clips:
        if clip.fps != clip.header_fps:
            rates = f"{clip.fps:g} Hz, {clip.fps_reason}; the header says {clip.header_fps:g} Hz"
            folder = Path(clip.source).parent.as_posix()
            corrected.setdefault(f"{folder}: {rates}", []).append(Path(clip.source).name)
        if clip.fps_reason == HEADER and not is_known_rate(clip.fps):
            odd.setdefault(clip.fps, []).append(clip.source)
    for correction, names in corrected.items():
        yield f"{correction} ({_some(names, 3)})"
    for fps, names in odd.items():
        usual = f"--fps {nearest_rate(fps):g} if that is meant"
        yield f"the header's {fps:.6g} Hz may be a frame time cut off too early; {usual} ({_some(names, 3)})"
    yield from (f"{skeleton.name}: {skeleton.note}" for skeleton in maps.values() if skeleton.note)
    for name in maps:
        yield from _skeleton_notes(name, [clip for clip in clips if clip.skeleton == name])
    if jumping := [clip.source for clip in clips if (clip.first_step or 0.0) > JUMP]:
        yield (
            f"{_some(jumping, 1)}: frame 0 is far from frame 1, as a T-pose is before the motion; "
            "calibration_frame: true in a custom map leaves it out"
        )
    floorless = [clip.source for clip in clips if clip.floor is None]
    if how.floor == AUTO and floorless:
        yield f"{_some(floorless, 1)}: no foot stands still, so the floor is as in the file"


def _skeleton_notes(name: str, clips: Sequence[Imported]) -> Iterator[str]:
    for key in ("up", "unit"):
        found = Counter(getattr(clip, key) for clip in clips)
        if len(found) > 1:
            several = ", ".join(f"{value} in {count} clips" for value, count in found.most_common())
            yield f"{name}: {key} is found as {several}; set it in the map if that is wrong"
    count = sum(clip.stance.endswith(STRAIGHTEST) for clip in clips)
    if count > 1:
        yield (
            f"{name}: the zero pose of {count} clips is not a stance, so each is read from its own frame, "
            "and head, hands and feet may be turned differently; a rest in the map avoids that"
        )


def _some(names: Sequence[str], count: int) -> str:
    """Return the first names, and how many more there are."""
    return ", ".join(names[:count]) + (f" and {len(names) - count} more" if len(names) > count else "")
