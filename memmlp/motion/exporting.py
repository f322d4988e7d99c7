"""Exports clips to files that other programs open: a folder of AMASS npz, or a single file."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from memmlp.common.errors import InputError, escape_line_breaks
from memmlp.common.progress import progress_bar
from memmlp.motion.body import check_imported_body, load_rest_joints
from memmlp.motion.clip import Clip, SkippedFile, describe_first, resample
from memmlp.motion.formats.bvh import write_bvh
from memmlp.motion.formats.gltf import write_gltf
from memmlp.motion.formats.npz import NoMotionError, read_clip, write_clip
from memmlp.motion.plausibility import check_plausible
from memmlp.motion.preparing.find_clips import find_clips, get_clip_name

T = TypeVar("T")


class Format(NamedTuple):
    """A file format for exported clips. `write` writes a clip atomically; its last argument is the rest
    joints (22, 3), metres. `has_bones`: whether files contain the body's bones."""

    suffix: str
    write: Callable[[Path, Clip, np.ndarray], None]
    has_bones: bool = True


FORMATS = {
    "bvh": Format(".bvh", write_bvh),
    "npz": Format(".npz", lambda path, clip, rest: write_clip(path, clip), has_bones=False),
    "gltf": Format(".glb", write_gltf),
}
SUFFIXES = {each.suffix: each for each in FORMATS.values()}


def find_format(path: Path, key: str = "path") -> Format:
    """Find the format for a file's suffix. Raises InputError, with the option or argument `key`, if there is
    none."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{key} {path}: the suffix must be one of {', '.join(SUFFIXES)}")
    return SUFFIXES[path.suffix.lower()]


def write_motion(path: Path, clip: Clip, rest: np.ndarray, target_format: Format) -> None:
    """Write a clip in a format, atomically. Missing folders are created. Raises InputError if this fails."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        target_format.write(path, clip, rest)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from error


@dataclass(frozen=True)
class ExportTarget:
    """A clip to be written: its name (its path below the source folder without suffix), npz file, and file to
    write."""

    name: str
    source: Path
    path: Path


@dataclass(frozen=True)
class ExportPlan:
    """The clips that an export writes, their format, and the folders that cannot be listed."""

    targets: tuple[ExportTarget, ...]
    format: Format
    skipped: tuple[SkippedFile, ...] = ()


@dataclass(frozen=True)
class ExportReport:
    """The report of an export: the files and their total duration in seconds, the skipped clips, and clip ->
    its likely mistakes."""

    written: tuple[Path, ...]
    seconds: float
    skipped: tuple[SkippedFile, ...]
    unusual: Mapping[str, str] = field(default_factory=dict)


def plan_export(source: Path, out: Path, name: str | None = None) -> ExportPlan:
    """Plan the export of one npz file to the file `out`, or of a folder of npz files to the folder `out`,
    with the same relative paths. The format `name` is one of FORMATS; None chooses it by the suffix. Raises
    InputError if there is nothing to export, the format is unknown, `out` is a file instead of a folder or
    vice versa, or a source would be overwritten."""
    if not source.exists():
        raise InputError(f"{source}: no such file or folder; expected an npz file or a folder of npz files")
    target_format = choose_format(out, name, folder=source.is_dir())
    if not source.is_dir():
        if out.resolve() == source.resolve():
            raise InputError(f"--out {out}: must differ from the source file")
        return ExportPlan((ExportTarget(source.stem, source, out),), target_format)
    above, below = source.resolve(), out.resolve()
    if below.is_relative_to(above) or above.is_relative_to(below):
        raise InputError(f"--out {out}: must be neither inside nor above {source}; choose a separate folder")
    content = find_clips(source)
    names = {file: get_clip_name(file) for file in content.files}
    first, count = Counter(names.values()).most_common(1)[0]
    if count > 1:
        raise InputError(f"{source / first}: {count} npz files have this name; expected one")
    targets = tuple(ExportTarget(n, source / f, out / (n + target_format.suffix)) for f, n in names.items())
    return ExportPlan(targets, target_format, tuple(SkippedFile(*one) for one in content.unreadable.items()))


def choose_format(out: Path, name: str | None, folder: bool) -> Format:
    """Choose the named format for `out`, or else that of its suffix. Raises InputError if the format is
    unknown, name and suffix contradict each other, or `out` is a file instead of a folder or vice versa."""
    if folder and name is None:
        raise InputError(f"--format: required for a folder; must be one of {', '.join(FORMATS)}")
    if folder and (out.is_file() or out.suffix.lower() in SUFFIXES):
        raise InputError(f"--out {out}: must be a folder for several clips, not a file")
    if not folder and out.is_dir():
        raise InputError(f"--out {out}: must be a file for one clip, not a folder")
    if folder:
        return FORMATS[str(name)]
    suffix_format = find_format(out, "--out")
    if name is not None and FORMATS[name] is not suffix_format:
        raise InputError(f"--out {out}: the suffix must be {FORMATS[name].suffix} for --format {name}")
    return suffix_format


def export(
    plan: ExportPlan, *, body: str = "builtin", fps: float | None = None, strict: bool = False
) -> ExportReport:
    """Write a plan's clips, resampled to `fps` unless it is None. `body` (`builtin`, or an SMPL-H model.npz)
    determines the bones in formats that have bones. A bad file is skipped and reported unless `strict` is set
    or it is the only one. Raises InputError for an invalid body, or a body that differs from the body of the
    clips' import; if no clip could be read, or a file cannot be written."""
    rest = load_rest_joints(body)
    if plan.format.has_bones:
        check_imported_body([target.source for target in plan.targets], rest, f"--body {body}")
    return convert_and_export(
        plan,
        rest,
        lambda target, clip: clip if fps is None else resample(clip, fps)[0],
        lambda names, clips: clips,
        strict=strict,
    )


def convert_and_export(
    plan: ExportPlan,
    rest: np.ndarray,
    prepare: Callable[[ExportTarget, Clip], T],
    finish: Callable[[Sequence[str], Sequence[T]], Sequence[Clip]],
    *,
    batch: int = 1,
    strict: bool = False,
) -> ExportReport:
    """Convert a plan's clips and write them on a body with rest joints (22, 3), metres, with a progress bar.
    `prepare` is the first step, for one clip; it may raise InputError. `finish` is the second step, for up to
    `batch` clips: names and prepared clips -> converted clips. A bad file is skipped and reported unless
    `strict` is set or it is the only one. Raises InputError for a bad file, if no clip could be read, or if a
    file cannot be written."""
    skipped, faults = list(plan.skipped), dict[str, str]()
    written, seconds = list[Path](), 0.0

    def read() -> Iterator[tuple[ExportTarget, T]]:
        single = len(plan.targets) == 1
        for target in progress_bar(plan.targets, "export"):
            try:
                clip = read_clip(target.source, target.name)
                clip_faults = check_plausible(target.source, clip)
                content = prepare(target, clip)
            except InputError as error:
                no_motion = isinstance(error, NoMotionError)  # AMASS folders also contain shape files
                if single or (strict and not no_motion):
                    raise
                reason = str(error).removeprefix(escape_line_breaks(f"{target.source}: "))
                skipped.extend([] if no_motion else [SkippedFile(target.name + target.source.suffix, reason)])
                continue
            faults.update({target.name: clip_faults} if clip_faults else {})
            yield target, content

    contents = read()
    while chunk := list(islice(contents, batch)):
        targets, parts = zip(*chunk, strict=True)
        clips = finish([target.name for target in targets], parts)
        for target, clip in zip(targets, clips, strict=True):
            write_motion(target.path, clip, rest, plan.format)
            written.append(target.path)
            seconds += len(clip) / clip.fps
    if not written:
        found = f"no usable clip in {len(plan.targets)} files{describe_first(skipped)}"
        raise InputError(f"{found}; expected AMASS npz files")
    return ExportReport(tuple(written), seconds, tuple(skipped), faults)
