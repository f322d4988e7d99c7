"""Imports a folder of recordings as AMASS npz files with a record, or checks it by a trial import."""

import hashlib
import json
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write
from memmlp.common.progress import progress_bar
from memmlp.motion.body import RECORD, describe_body, load_rest_joints
from memmlp.motion.clip import FRAME_RATE_RANGE, SkippedFile, describe_first
from memmlp.motion.formats.npz import write_clip
from memmlp.motion.formats.recording import Recording
from memmlp.motion.geometry import limit_to_one_thread
from memmlp.motion.importing.convert import (
    AUTO,
    JUMP,
    STRAIGHTEST,
    Conversion,
    convert_recording,
    measure_first_step,
)
from memmlp.motion.importing.fidelity import Fidelity
from memmlp.motion.importing.recordings import (
    Rate,
    find_rate,
    find_recordings,
    make_folder_key,
    read_recording,
)
from memmlp.motion.importing.skeleton_map import SkeletonMap, find_skeleton, is_number, load_skeleton
from memmlp.motion.preparing.find_clips import find_files


@dataclass(frozen=True)
class ImportedClip:
    """One imported clip, as written to the record. `source` and `clip` are paths below the folders; `unit` is
    the file's in metres, `up` its axis, `y` or `z`; rates are in Hz; `floor` is the subtracted height, metres
    at the body's scale, or None; `scale` is the body's size divided by that in the file; `first_step` is that
    of `convert.measure_first_step`, 0 if the map excludes frame 0; `faults` are those of `Fidelity`."""

    source: str
    sha256: str
    clip: str
    skeleton: str
    unit: float
    up: str
    stance: str
    frames: int
    header_fps: float | None
    fps: float
    fps_reason: str
    floor: float | None
    scale: float
    first_step: float
    faults: tuple[str, ...]


@dataclass(frozen=True)
class ImportReport:
    """The report of an import: the written clips, notes for the user, such as corrected frame rates, and
    skipped files."""

    clips: tuple[ImportedClip, ...]
    notes: tuple[str, ...]
    skipped: tuple[SkippedFile, ...]


@dataclass(frozen=True)
class ImportSettings:
    """The settings of an import. `floor` is that of `convert_recording`."""

    skeleton: str | None = None  # a shipped map's name, or a map's path; None chooses by each file's joints
    fps: Mapping[str, float] = field(default_factory=dict)  # folder in the source ("": all) -> rate, Hz
    body: str = "builtin"  # or an SMPL-H model.npz
    floor: str | float = AUTO
    strict: bool = False  # whether a bad file raises an error; otherwise it is skipped and reported
    sound: bool = False  # whether to skip clips with likely mistakes; otherwise they are written and reported
    up: str | None = None  # the files' up axis, `y` or `z`; None uses the map's


def import_folder(source: Path, out: Path, settings: ImportSettings | None = None) -> ImportReport:
    """Import each file of a folder, or a single file, as OUT/RELATIVE_PATH.npz, and write OUT/import.json.
    Raises InputError if there are no files, several files have one name, a rate has an unknown folder, `out`
    has clips of a different import or cannot be written, or no file can be imported. Then nothing is written.
    """
    settings, files = settings or ImportSettings(), find_recordings(source)
    _check_import(files, out, settings)
    settings = replace(settings, strict=settings.strict or len(files) == 1)
    rest, clips, skipped = load_rest_joints(settings.body), [], list[SkippedFile]()
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}-") as staging:
            folder = Path(staging) / "clips"
            folder.mkdir()
            for relative, result in _convert_all(files, settings, rest):
                if isinstance(result, SkippedFile):
                    skipped.append(result)
                    continue
                write_clip(folder / relative.with_suffix(".npz"), result.converted.clip)
                clips.append(_describe_clip(relative, result))
            if not clips:
                raise InputError(f"{source}: no usable file of {len(files)}{describe_first(skipped)}")
            report = ImportReport(tuple(clips), tuple(_write_notes(clips, settings)), tuple(skipped))
            _publish(folder, out, report, describe_body(settings.body, rest))
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror})") from error
    return report


def verify_folder(source: Path, settings: ImportSettings | None = None) -> Iterator[Fidelity | SkippedFile]:
    """Import each file of a folder, or a single file, without writing it. Yield for each file the comparison
    of clip and file, or the reason why it cannot be imported. Raises InputError if there are no files, or the
    skeleton or body does not exist."""
    settings = settings or ImportSettings()
    rest = load_rest_joints(settings.body)
    for relative, result in _convert_all(find_recordings(source), settings, rest):
        if isinstance(result, SkippedFile):
            yield result
        else:
            yield replace(result.converted.fidelity, name=relative.as_posix())


@dataclass(frozen=True)
class _ConvertedFile:
    recording: Recording
    skeleton: SkeletonMap
    rate: Rate
    converted: Conversion


def _convert_all(
    files: Mapping[Path, Path], settings: ImportSettings, rest: np.ndarray
) -> Iterator[tuple[Path, _ConvertedFile | SkippedFile]]:
    """Yield each file's path below the folder, and its conversion or the reason to skip it."""
    user_map = None if settings.skeleton is None else load_skeleton(settings.skeleton)
    for relative, path in progress_bar(files.items(), "import", len(files)):
        try:
            recording = read_recording(path)
            skeleton = find_skeleton(recording, user_map)
            skeleton = replace(skeleton, up=settings.up or skeleton.up)
            rate, name = find_rate(recording, relative, settings.fps), relative.with_suffix("").as_posix()
            with limit_to_one_thread():
                converted = convert_recording(
                    recording, skeleton, rest, name=name, fps=rate.fps, floor=settings.floor
                )
            if settings.sound and converted.fidelity.faults:
                faults = "; ".join(converted.fidelity.faults)
                raise InputError(f"{path}: {faults}; --sound accepts only clips without likely mistakes")
        except InputError as error:
            if settings.strict:
                raise
            yield relative, SkippedFile(relative.as_posix(), str(error).replace(f"{path}: ", ""))
        else:
            yield relative, _ConvertedFile(recording, skeleton, rate, converted)


def _check_import(files: Mapping[Path, Path], out: Path, settings: ImportSettings) -> None:
    """Raise InputError for several sources of a clip, foreign clips in `out`, or invalid rates."""
    npz, count = Counter(relative.with_suffix(".npz") for relative in files).most_common(1)[0]
    if count > 1:
        raise InputError(f"{npz.with_suffix('').as_posix()}: {count} recordings have this name; expected one")
    expected = {path.with_suffix(".npz") for path in files}
    foreign = sorted(set(map(Path, find_files(out, ".npz").files)) - expected)
    if foreign or (out.exists() and not out.is_dir()):
        problem = f"has other clips, such as {foreign[0].as_posix()}" if foreign else "is a file"
        raise InputError(f"{out}: {problem}; must be a new folder, or the folder of the same import")
    folders = sorted({make_folder_key(folder) for relative in files for folder in relative.parents} - {""})
    for folder, rate in settings.fps.items():
        option = f"--fps {f'{folder}=' * bool(folder)}{rate:g}"
        if not is_number(rate, *FRAME_RATE_RANGE):
            raise InputError(f"{option}: the frame rate must be 1 to 1000 Hz")
        if folder and folder not in folders:
            choices = f", or FOLDER=HZ with {_format_names(folders, 8)}" if folders else ""
            raise InputError(f"{option}: no recordings in a folder {folder}; must be HZ for all{choices}")


def _describe_clip(relative: Path, result: _ConvertedFile) -> ImportedClip:
    converted, recording = result.converted, result.recording
    return ImportedClip(
        source=relative.as_posix(),
        sha256=hashlib.sha256(recording.path.read_bytes()).hexdigest(),
        clip=relative.with_suffix(".npz").as_posix(),
        skeleton=result.skeleton.name,
        unit=float(converted.fitted.skeleton.unit or 1.0),
        up=str(converted.fitted.skeleton.up),
        stance=converted.fitted.stance.source,
        frames=len(converted.clip),
        header_fps=recording.fps,
        fps=result.rate.fps,
        fps_reason=result.rate.reason,
        floor=converted.floor,
        scale=converted.fitted.scale,
        first_step=0.0 if result.skeleton.calibration_frame else measure_first_step(recording),
        faults=converted.fidelity.faults,
    )


def _publish(staging: Path, out: Path, report: ImportReport, body: Mapping[str, str]) -> None:
    """Move the clips and the record from the staging folder to `out`; remove old clips of skipped files. If
    `out` is new, the staging folder is renamed, so `out` is complete at once. Otherwise the old record is
    removed first, and the new record is written last. A folder without a record is therefore incomplete: it
    may have clips of two imports."""
    record = {**body, **asdict(report)}
    atomic_write(staging / RECORD, json.dumps(record, indent=1) + "\n")
    if not out.exists():
        staging.rename(out)
        return
    (out / RECORD).unlink(missing_ok=True)
    for name in [*(clip.clip for clip in report.clips), RECORD]:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.move(staging / name, out / name)
    for skipped in report.skipped:
        (out / Path(skipped.file).with_suffix(".npz")).unlink(missing_ok=True)


def _write_notes(clips: Sequence[ImportedClip], settings: ImportSettings) -> Iterator[str]:
    corrected: dict[str, list[str]] = {}
    for clip in clips:
        if clip.header_fps not in (None, clip.fps):
            rates = f"{clip.fps:g} Hz, {clip.fps_reason}; the header has {clip.header_fps:g} Hz"
            folder = Path(clip.source).parent.as_posix()
            corrected.setdefault(f"{folder}: {rates}", []).append(Path(clip.source).name)
    for correction, names in corrected.items():
        yield f"{correction} ({_format_names(names, 3)})"
    for name in sorted({clip.skeleton for clip in clips}):
        clips_of_map = [clip for clip in clips if clip.skeleton == name]
        for key in ("up", "unit"):
            counts = Counter(getattr(clip, key) for clip in clips_of_map)
            if len(counts) > 1:
                several = ", ".join(f"{value} in {count} clips" for value, count in counts.most_common())
                yield f"{name}: {key} differs between clips: {several}; if this is wrong, set it in the map"
        count = sum(clip.stance.startswith(STRAIGHTEST) for clip in clips_of_map)
        if count > 1:
            cause = f"{name}: the zero pose of {count} clips is not a stance, so each clip uses a frame"
            effect = "head, hands and feet may be rotated differently"
            yield f"{cause}, and {effect}; add rest to the map to avoid this"
    if jumping := [clip.source for clip in clips if clip.first_step > JUMP]:
        wrong = f"{_format_names(jumping, 1)}: frame 0 is far from frame 1, so it may be a T-pose"
        yield f"{wrong}; exclude frame 0 with calibration_frame: true in a custom map"
    floorless = [clip.source for clip in clips if clip.floor is None]
    if settings.floor == AUTO and floorless:
        yield f"{_format_names(floorless, 1)}: no foot stands still, so the floor height was not corrected"


def _format_names(names: Sequence[str], count: int) -> str:
    return ", ".join(names[:count]) + (f" and {len(names) - count} more" if len(names) > count else "")
