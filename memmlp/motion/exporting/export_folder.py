"""Exports a folder of AMASS npz, or a single file: each clip becomes a file of the same name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from memmlp.common.errors import InputError, one_line
from memmlp.common.progress import progress_bar
from memmlp.motion.body import load_rest_joints
from memmlp.motion.clip import Clip, Skipped, resample
from memmlp.motion.exporting.write import FORMATS, SUFFIXES, Format, format_of, write_motion
from memmlp.motion.formats.npz import NoMotion, read_clip
from memmlp.motion.plausibility import check_plausible, unusual
from memmlp.motion.preparing.find_clips import clip_name, find_clips
from memmlp.motion.preparing.imported_body import check_imported_body

T = TypeVar("T")


@dataclass(frozen=True)
class Target:
    """A clip to be written.

    Attributes:
        name: the clip's name: its path below the source folder, without suffix.
        source: the clip's npz file.
        path: the file to write.
    """

    name: str
    source: Path
    path: Path

    @property
    def file(self) -> str:
        """The source's path below its folder."""
        return self.name + self.source.suffix


@dataclass(frozen=True)
class ExportPlan:
    """The clips that an export writes, and their format.

    Attributes:
        targets: the clips.
        format: the format of the files.
        skipped: folders that cannot be listed.
    """

    targets: tuple[Target, ...]
    format: Format
    skipped: tuple[Skipped, ...] = ()


@dataclass(frozen=True)
class ExportReport:
    """The result of an export.

    Attributes:
        written: the files that were written.
        seconds: the total duration of the written clips.
        skipped: the clips that were skipped.
        unusual: clip -> what is odd about it, though it may be sound.
    """

    written: tuple[Path, ...]
    seconds: float
    skipped: tuple[Skipped, ...]
    unusual: Mapping[str, str] = field(default_factory=dict)


def plan_export(source: Path, out: Path, name: str | None = None) -> ExportPlan:
    """Plan the export of an npz file to the file `out`, or of a folder's npz files to the folder `out`.

    Args:
        source: file or folder.
        out: file or folder; in a folder each file has its source's path, with the format's suffix.
        name: the format, one of FORMATS; by default a file's suffix decides.

    Raises:
        InputError: if there is nothing to export, the format is unclear, `out` is a file where a folder is
            needed or the other way round, or a file would be written over a source.
    """
    if not source.exists():
        raise InputError(f"{source}: no such file or folder; allowed: an npz file, or a folder of such")
    chosen = choose_format(out, name, folder=source.is_dir())
    if source.is_dir():
        return _plan_folder(source, out, chosen)
    if out.resolve() == source.resolve():
        raise InputError(f"--out {out}: would be written over its source; allowed: another file")
    return ExportPlan((Target(source.stem, source, out),), chosen)


def _plan_folder(source: Path, out: Path, chosen: Format) -> ExportPlan:
    """Plan the export of a folder."""
    _check_folder(source, out)
    found = find_clips(source)
    targets = tuple(_targets(source, found.files, out, chosen.suffix))
    path, count = Counter(target.path for target in targets).most_common(1)[0]
    if count > 1:
        raise InputError(f"{path}: {count} npz files of this name in {source}; allowed: one")
    return ExportPlan(
        targets, chosen, tuple(Skipped(folder, reason) for folder, reason in found.unreadable.items())
    )


def choose_format(out: Path, name: str | None, folder: bool) -> Format:
    """Return the format of the file, or the folder of files, `out`: the named format, or its suffix's.

    Raises:
        InputError: if neither determines the format, they contradict each other, a folder has a file's
            suffix, or a file is a folder.
    """
    if folder and name is None:
        raise InputError(f"--format: needed for a folder; allowed: {', '.join(FORMATS)}")
    if folder and (out.is_file() or out.suffix.lower() in SUFFIXES):
        raise InputError(f"--out {out}: is a file, or named as one; allowed for several clips: a folder")
    if not folder and out.is_dir():
        raise InputError(f"--out {out}: is a folder; allowed for one clip: a file")
    if folder:
        return FORMATS[str(name)]
    chosen = format_of(out, "--out")
    if name is not None and FORMATS[name] is not chosen:
        raise InputError(f"--out {out}: not a file of --format {name}; allowed: *{FORMATS[name].suffix}")
    return chosen


def _targets(folder: Path, files: list[str], out: Path, suffix: str) -> Iterator[Target]:
    """Yield a target below `out` for each file of a folder."""
    for file in files:
        name = clip_name(file)
        yield Target(name, folder / file, out / (name + suffix))


def _check_folder(source: Path, out: Path) -> None:
    """Raise InputError if files below `out` could overwrite sources, or be taken for sources later."""
    above, below = source.resolve(), out.resolve()
    if below.is_relative_to(above) or above.is_relative_to(below):
        raise InputError(f"--out {out}: in {source}, or around it; allowed: a folder beside it")


def read_targets(
    plan: ExportPlan, read: Callable[[Target], T], skipped: list[Skipped], strict: bool = False
) -> Iterator[tuple[Target, T]]:
    """Yield each target of a plan with what is read of its source, while a progress bar counts them.

    Args:
        plan: the targets.
        read: reads a target's source, or raises InputError: NoMotion for a file that is no clip at all.
        skipped: gets the other sources that cannot be read, unless the plan has only one target.
        strict: whether the first source that cannot be read raises instead.

    Raises:
        InputError: as described above, and at the end if every source was skipped.
    """
    alone, usable = len(plan.targets) == 1, False
    for target in progress_bar(plan.targets, "export"):
        try:
            found = read(target)
        except InputError as error:
            if alone or (strict and not isinstance(error, NoMotion)):
                raise
            if not isinstance(error, NoMotion):  # AMASS has files of shapes beside its clips
                skipped.append(Skipped(target.file, str(error).removeprefix(one_line(f"{target.source}: "))))
        else:
            usable = True
            yield target, found
    if not usable:
        first = f"; the first: {skipped[0].file}: {skipped[0].reason}" if skipped else ""
        raise InputError(f"no usable clip in {len(plan.targets)} files{first}; allowed: AMASS npz files")


def read_motion(target: Target, odd: dict[str, str]) -> Clip:
    """Read a target's clip.

    Args:
        target: the target.
        odd: gets what is unusual of the clip, by its name.

    Raises:
        InputError: if it is damaged or can't be a person's motion.
    """
    clip = read_clip(target.source, target.name)
    check_plausible(target.source, clip)
    if reason := unusual(clip):
        odd[target.name] = reason
    return clip


def export(
    plan: ExportPlan, *, body: str = "builtin", fps: float | None = None, strict: bool = False
) -> ExportReport:
    """Write a plan's clips.

    Args:
        plan: what to write.
        body: `builtin`, or an SMPL-H model.npz; it gives the bones in formats that have bones.
        fps: frame rate, Hz, to which the clips are resampled; by default each keeps its own.
        strict: whether a bad file raises; otherwise it is skipped and reported, if there are other files.

    Raises:
        InputError: for a bad body, or one that the clips were not imported onto where the format has bones;
            if no clip could be read, or a file cannot be written.
    """
    rest = load_rest_joints(body)
    if plan.format.has_bones:
        check_imported_body([target.source for target in plan.targets], rest, f"--body {body}")
    written: list[Path] = []
    skipped, odd = list(plan.skipped), dict[str, str]()
    seconds = 0.0
    for target, clip in read_targets(plan, lambda target: _motion(target, fps, odd), skipped, strict):
        write_motion(target.path, clip, rest, plan.format)
        written.append(target.path)
        seconds += len(clip) / clip.fps
    return ExportReport(tuple(written), seconds, tuple(skipped), odd)


def _motion(target: Target, fps: float | None, odd: dict[str, str]) -> Clip:
    """Read the clip that is to be written to a target, resampled to `fps` if that is given."""
    clip = read_motion(target, odd)
    return clip if fps is None else resample(clip, fps)[0]
