"""Imports a folder of recordings as AMASS npz, with a record of sources and settings, or nothing at all."""

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
from memmlp.motion.clip import FRAME_RATE_RANGE, Skipped
from memmlp.motion.clip_kinematics import clip_kinematics
from memmlp.motion.formats.npz import read_clip, write_clip
from memmlp.motion.frame_rates import is_known_rate, nearest_rate
from memmlp.motion.importing.calibration_frame import JUMP, first_step
from memmlp.motion.importing.convert import AUTO, convert, lowered
from memmlp.motion.importing.fidelity import FEET_STAY, off_the_floor
from memmlp.motion.importing.importable_files import find_recordings, read_recording, tells_rate
from memmlp.motion.importing.motion_file import MotionFile
from memmlp.motion.importing.reading_stance import STRAIGHTEST
from memmlp.motion.importing.skeleton_map import SkeletonMap, find_skeleton, is_number, load_skeleton
from memmlp.motion.importing.true_rate import HEADER, SIDECAR, folder_key, true_rate
from memmlp.motion.preparing.groups import Grouping
from memmlp.motion.preparing.imported_body import RECORD, body_record
from memmlp.motion.torch_threads import one_thread


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
        stance: the stance from which the skeleton was read, in words; a key of the record.
        frames: number of frames.
        header_fps: frame rate in the file's header, Hz.
        fps: frame rate of the clip, Hz.
        fps_reason: where the clip's frame rate is from.
        floor: height of the floor that was subtracted, metres at the body's size; None if none was found or
            asked for.
        scale: the body's size, as a multiple of the file's.
        first_step: how far frame 0 of the clip is from frame 1, in multiples of other frames' steps
            (`calibration_frame.first_step`); None where the map leaves frame 0 of the file out.
        faults: what is wrong with the clip, one sentence each (`fidelity.compare`).
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
        notes: what the user should know of the clips: folders whose frame rates were corrected, notes of the
            maps.
        skipped: the files that were skipped.
    """

    clips: tuple[Imported, ...]
    notes: tuple[str, ...]
    skipped: tuple[Skipped, ...]


@dataclass(frozen=True)
class ImportSettings:
    """How files are imported.

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
        out: folder; it must hold no clips other than this import's.
        how: how files are imported.

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
    with _staging(out) as staging, one_thread():
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
        clips = _one_floor_a_take(clips, takes, folder, rest)
        if how.sound:
            clips = _without_faults(clips, folder, skipped, files, how.strict)
        if not clips:
            first = f"the first: {skipped[0].file}: {skipped[0].reason}"
            raise InputError(f"{source}: no usable file of {len(files)}; {first}")
        notes = (*_take_notes(names, how.takes), *_notes(clips, maps, how))
        report = ImportReport(tuple(clips), notes, tuple(skipped))
        _publish(folder, out, report, body_record(how.body, rest))
    return report


def _one_floor_a_take(
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
            motion = lowered(read_clip(path, clip.clip), floor - (clip.floor or 0.0))
            write_clip(path, motion)
            others = (fault for fault in clip.faults if not fault.startswith(FEET_STAY))
            faults = (*others, *off_the_floor(clip_kinematics(motion, rest)[1]))
            clips[index] = replace(clip, floor=floor, faults=faults)
    return clips


def _without_faults(
    clips: Sequence[Imported], staging: Path, skipped: list[Skipped], files: Mapping[Path, Path], strict: bool
) -> list[Imported]:
    """Return the clips without faults; the others are removed and `skipped`, or raise if `strict`.

    Raises:
        InputError: for the first clip with faults if `strict`.
    """
    for clip in clips:
        if clip.faults:
            wrong = _unsound(clip.faults)
            if strict:
                raise InputError(f"{files[Path(clip.source)]}: {wrong}")
            skipped.append(Skipped(clip.source, wrong))
            (staging / clip.clip).unlink()
    return [clip for clip in clips if not clip.faults]


def _unsound(faults: Sequence[str]) -> str:
    return f"{'; '.join(faults)}; allowed: no faults (--sound)"


def _npz(relative: Path) -> Path:
    """Return a clip's path below `out`, given its source's path below the source folder."""
    return relative.with_suffix(".npz")


def _check_import(files: Mapping[Path, Path], out: Path, how: ImportSettings) -> None:
    """Raise InputError for two sources of one clip, foreign clips in `out`, or wrong takes or rates."""
    npz, count = Counter(_npz(relative) for relative in files).most_common(1)[0]
    if count > 1:
        raise InputError(f"{npz.with_suffix('').as_posix()}: {count} recordings of this name; allowed: one")
    foreign = sorted({path.relative_to(out) for path in out.rglob("*.npz")} - {_npz(path) for path in files})
    if foreign or (out.exists() and not out.is_dir()):
        wrong = f"has other clips, such as {foreign[0].as_posix()}" if foreign else "is a file"
        raise InputError(f"{out}: {wrong}; allowed: a new folder, or that of the same import")
    for pattern in how.takes:
        try:
            re.compile(pattern)
        except re.error as error:
            raise InputError(f"take: {pattern!r}: {error}; allowed: a regular expression") from error
    folders = sorted({folder_key(folder) for relative in files for folder in relative.parents})
    for folder, rate in how.fps.items():
        if folder not in folders or not is_number(rate, *FRAME_RATE_RANGE):
            allowed = f"1 to 1000 Hz for {', '.join(map(repr, folders))} ('' is all)"
            raise InputError(f"fps: {rate!r} for {folder!r}; allowed: {allowed}")


def _staging(out: Path) -> tempfile.TemporaryDirectory:
    """Make a folder beside `out`, in which an import grows until it is complete."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        return tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}-")
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); allowed: a new folder") from error


def _import_file(
    recording: MotionFile,
    relative: Path,
    folder: Path,
    skeleton: SkeletonMap,
    how: ImportSettings,
    rest: np.ndarray,
    source: Path,
) -> Imported:
    """Write one clip below the staging folder."""
    content = recording.path.read_bytes()
    top = source if source.is_dir() else source.parent
    rate = true_rate(recording.fps, relative, content, top, how.fps)
    if rate.reason == HEADER and not tells_rate(recording.path):
        allowed = f"--fps HZ, {recording.fps:g} for the published files, or {SIDECAR}"
        raise InputError(f"{recording.path}: this format tells no frame rate; allowed: {allowed}")
    name = relative.with_suffix("").as_posix()
    converted = convert(recording, skeleton, rest, name=name, fps=rate.fps, floor=how.floor)
    if how.sound and converted.fidelity.faults:
        raise InputError(f"{recording.path}: {_unsound(converted.fidelity.faults)}")
    write_clip(folder / _npz(relative), converted.clip)
    return Imported(
        source=relative.as_posix(),
        sha256=hashlib.sha256(content).hexdigest(),
        clip=_npz(relative).as_posix(),
        skeleton=skeleton.name,
        unit=converted.unit,
        up=converted.up,
        stance=converted.stance_words,
        frames=len(converted.clip),
        header_fps=recording.fps,
        fps=rate.fps,
        fps_reason=rate.reason,
        floor=converted.floor,
        scale=converted.scale,
        first_step=None if skeleton.calibration_frame else first_step(recording),
        faults=converted.fidelity.faults,
    )


def _take_notes(names: Mapping[str, str], takes: Sequence[str]) -> Iterator[str]:
    """Yield a line for each pattern of takes that ties no two clips."""
    for pattern in takes:
        if len(set(Grouping([pattern]).names(names).values())) == len(names):
            yield f"--take {pattern}: ties no two clips; it sees names such as {min(names.values())}"


def _notes(clips: Sequence[Imported], maps: Mapping[str, SkeletonMap], how: ImportSettings) -> Iterator[str]:
    """Yield what the user should know of an import, one line each."""
    yield from _rate_notes([clip for clip in clips if clip.fps != clip.header_fps])
    yield from _odd_rate_notes([clip for clip in clips if clip.fps_reason == HEADER])
    yield from (f"{skeleton.name}: {skeleton.note}" for skeleton in maps.values() if skeleton.note)
    for name in maps:
        yield from _family_notes(name, [clip for clip in clips if clip.skeleton == name])
    if begun := [clip.source for clip in clips if (clip.first_step or 0.0) > JUMP]:
        more = f" and {len(begun) - 1} more" if len(begun) > 1 else ""
        yield (
            f"{begun[0]}{more}: frame 0 is far from frame 1, as a T-pose is before the motion; "
            "calibration_frame: true in a map of your own leaves it out"
        )
    floorless = [clip.source for clip in clips if clip.floor is None]
    if how.floor == AUTO and floorless:
        more = f" and {len(floorless) - 1} more" if len(floorless) > 1 else ""
        yield f"{floorless[0]}{more}: no foot stands still, so the floor is as in the file"


def _family_notes(name: str, clips: Sequence[Imported]) -> Iterator[str]:
    """Yield what may differ between the clips of one skeleton."""
    for key in ("up", "unit"):
        found = Counter(getattr(clip, key) for clip in clips)
        if len(found) > 1:
            several = ", ".join(f"{value} in {count} clips" for value, count in found.most_common())
            yield f"{name}: {key} is found as {several}; tell it in the map if that is wrong"
    read = [clip for clip in clips if clip.stance.endswith(STRAIGHTEST)]
    if len(read) > 1:
        each = f"{len(read)} clips, whose zero pose is no stance, are each read from a frame of their own"
        yield f"{name}: {each}, so head, hands and feet may be turned differently; a map's rest mends that"


def _rate_notes(clips: Sequence[Imported]) -> Iterator[str]:
    """Describe corrected rates, one line for all clips of a folder with the same correction."""
    alike: dict[str, list[str]] = {}
    for clip in clips:
        told = f"{clip.fps:g} Hz, {clip.fps_reason}; the header says {clip.header_fps:g} Hz"
        alike.setdefault(f"{Path(clip.source).parent.as_posix()}: {told}", []).append(Path(clip.source).name)
    for told, names in alike.items():
        yield f"{told} ({_first(names)})"


def _odd_rate_notes(clips: Sequence[Imported]) -> Iterator[str]:
    """Describe rates of headers that motion is not usually recorded at, one line for all clips of a rate."""
    alike: dict[float, list[str]] = {}
    for clip in clips:
        if not is_known_rate(clip.fps):
            alike.setdefault(clip.fps, []).append(clip.source)
    for fps, names in alike.items():
        usual = f"--fps {nearest_rate(fps):g} if that is meant"
        yield f"the header's {fps:.6g} Hz may be a frame time cut off too early; {usual} ({_first(names)})"


def _first(names: Sequence[str]) -> str:
    """Return the first three names, and how many more there are."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


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
            (out / _npz(Path(skipped.file))).unlink(missing_ok=True)
    except OSError as error:
        raise InputError(
            f"{out}: cannot be written ({error.strerror}); allowed: a folder to write to"
        ) from error
