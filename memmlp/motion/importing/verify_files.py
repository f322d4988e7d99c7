"""The check of files: imports each file, reads back what the import would keep, and compares."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.common.progress import progress_bar
from memmlp.motion.body import load_rest_joints
from memmlp.motion.formats.npz import read_clip, write_clip
from memmlp.motion.importing.convert import AUTO, convert
from memmlp.motion.importing.fidelity import Fidelity, compare
from memmlp.motion.importing.importable_files import find_recordings, read_recording
from memmlp.motion.importing.skeleton_map import find_skeleton, load_skeleton
from memmlp.motion.importing.true_rate import true_rate
from memmlp.motion.torch_threads import one_thread


@dataclass(frozen=True)
class Unusable:
    """A file that can't be imported.

    Attributes:
        name: the file's path below the folder.
        reason: why it can't be imported, in one line.
    """

    name: str
    reason: str


def verify(
    path: Path,
    *,
    skeleton: str | None = None,
    body: str = "builtin",
    name: str | None = None,
    floor: str | float = AUTO,
    up: str | None = None,
    top: Path | None = None,
) -> Fidelity:
    """Import a file, read the resulting npz, and compare it with the file.

    Args:
        path: the file.
        skeleton: the name of a shipped map, or the path of a map; by default the file's joints decide.
        body: `builtin`, or an SMPL-H model.npz.
        name: the name to report; by default the file's.
        floor: see `convert`.
        up: the file's up axis, `y` or `z`; None leaves it to the map.
        top: the imported folder, whose `motion.yaml` files tell frame rates; by default the file's own.

    Raises:
        InputError: if the file is damaged or fits no map, or a `motion.yaml` is damaged.
    """
    recording, rest = read_recording(path), load_rest_joints(body)
    chosen = find_skeleton(recording, load_skeleton(skeleton) if skeleton else None).with_up(up)
    top = top or path.parent
    rate = true_rate(recording.fps, path.relative_to(top), path.read_bytes(), top, {})
    with one_thread():
        converted = convert(recording, chosen, rest, name=name or path.name, fps=rate.fps, floor=floor)
    with tempfile.TemporaryDirectory() as folder:
        write_clip(Path(folder) / "clip.npz", converted.clip)
        clip = read_clip(Path(folder) / "clip.npz", converted.clip.name)
    return compare(clip, converted.mapped_motion, rest, chosen.name)


def verify_folder(
    source: Path,
    *,
    skeleton: str | None = None,
    body: str = "builtin",
    floor: str | float = AUTO,
    up: str | None = None,
) -> Iterator[Fidelity | Unusable]:
    """Verify each file of a folder, or a single one.

    Raises:
        InputError: if there is no file, or no such skeleton or body.
    """
    files = find_recordings(source)
    top = source if source.is_dir() else source.parent
    load_rest_joints(body)
    if skeleton is not None:
        load_skeleton(skeleton)
    for relative, path in progress_bar(files.items(), "verify", len(files)):
        name = relative.as_posix()
        try:
            yield verify(path, skeleton=skeleton, body=body, name=name, floor=floor, up=up, top=top)
        except InputError as error:
            yield Unusable(name, str(error).replace(f"{path}: ", ""))
