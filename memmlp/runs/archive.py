"""A run as one file: a zip of its own files, in a folder named by the run's id.

An archive is not trusted. It is unpacked into a temporary folder. Only names of a run's files are
accepted; nothing is executed or unpickled. Only a complete run, which fits the digests in its own files, is
then moved among the runs.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_file, file_digest, read_json, sync_folder
from memmlp.runs.identity import ID
from memmlp.runs.lookup import notes_path
from memmlp.runs.run import Run

MAX_FILES = 1000
MAX_SIZE = 4 * 10**9  # bytes of all files together, by default
PART = r"[\w.-]*[\w-]"  # a name of a folder or file; not ".."
ALLOWED = re.compile(
    "|".join(
        re.escape(pattern).replace(r"\*", PART)
        for pattern in (*Run.FILES, "notes.json", "DONE")
        if pattern != "FAILED"
    )
)
"""The files that an archive may hold: a run's own without a failure, its notes and its marker."""


def export_run(run: Run, out: Path) -> str:
    """Write a finished run to a file, and return the file's SHA-256.

    The checkpoint is left out, since a finished run is not resumed.

    Raises:
        InputError: if the run is not finished, or some of its files are missing or changed.
    """
    if not run.done:
        raise InputError(f"run {run.id}: must be finished, but is {run.status}")
    if changed := run.verify():
        raise InputError(f"run {run.id}: changed since it was made: {', '.join(changed)}")
    own = (path for pattern in run.FILES for path in sorted(run.folder.glob(pattern)))
    files = {path.relative_to(run.folder).as_posix(): path for path in (*own, notes_path(run), run.marker)}
    out.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(out) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, path in files.items():
            if ALLOWED.fullmatch(name) and path.is_file() and path != run.checkpoint:
                archive.write(path, f"{run.id}/{name}")
    return file_digest(out)


def import_run(
    path: Path,
    outputs: Path,
    sha256: str | None = None,
    largest: int = MAX_SIZE,
    tell: Callable[[str], None] = lambda line: None,
) -> tuple[Run, bool]:
    """Add the run in an archive to the runs of an outputs folder.

    Args:
        path: the archive.
        outputs: the outputs folder.
        sha256: the digest that the archive must have; None for any.
        largest: the largest allowed size of all files together, bytes.
        tell: gets a line if the run exists already without some evaluations or deployments of the archive.

    Returns:
        The run, and whether it is new; an existing run with the same weights is left unchanged.

    Raises:
        InputError: if the file is not an archive of a run, is too large, or a digest is wrong.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if sha256 is not None and file_digest(path) != sha256.lower():
        raise InputError(f"{path}: its SHA-256 is {file_digest(path)}, not {sha256}")
    try:
        with zipfile.ZipFile(path) as archive:
            run_id, names = _check_names(archive, path, largest)
            run, new = _place(archive, path, run_id, outputs)
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError) as error:
        raise InputError(f"{path}: not an archive of a run ({error})") from None
    missing = (name for name in names if "/" in name and not (run.folder / name).exists())
    if not new and (more := sorted({"/".join(name.split("/")[:2]) for name in missing})):
        tell(f"{path}: also has {', '.join(more)}, which is not added to run {run.id}")
    return run, new


def _check_names(archive: zipfile.ZipFile, path: Path, largest: int) -> tuple[str, list[str]]:
    """Return the run's id and the names of its files, after a check of names and sizes."""
    every = archive.namelist()
    run_id = every[0].partition("/")[0] if every else ""
    if len(every) > MAX_FILES or len(set(every)) != len(every) or not ID.fullmatch(run_id):
        raise InputError(f"{path}: not an archive of a run, whose folder must be named by 16 hex digits")
    for name in every:
        folder, _, own = name.partition("/")
        if folder != run_id or not ALLOWED.fullmatch(own):
            raise InputError(f"{path}: {name!r} is not a file of run {run_id}")
    if (total := sum(one.file_size for one in archive.infolist())) > largest:
        raise InputError(f"{path}: {total / 1e9:.1f} GB; must be at most {largest / 1e9:.1f} (--max-gb)")
    return run_id, [name.partition("/")[2] for name in every]


def _place(archive: zipfile.ZipFile, path: Path, run_id: str, outputs: Path) -> tuple[Run, bool]:
    """Unpack into a temporary folder, check the run there, and move it to its place."""
    place = Run.of(outputs, run_id)
    place.folder.parent.mkdir(parents=True, exist_ok=True)
    staging = Path(tempfile.mkdtemp(dir=place.folder.parent, prefix=".import-"))
    try:
        archive.extractall(staging)
        run = Run(staging / run_id)
        _check(run, path)
        if not place.folder.exists():
            os.rename(run.folder, place.folder)
            sync_folder(place.folder.parent)
            return place, True
        weights = file_digest(run.model)
        if not place.done or not place.model.is_file() or file_digest(place.model) != weights:
            raise InputError(f"{path}: run {place.id} exists already ({place.status}) with other weights")
        return place, False
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _check(run: Run, path: Path) -> None:
    """Raise InputError if the unpacked files are not an unchanged, finished run with that id."""
    if not run.done or run.manifest.get("id") != run.id or not run.config:
        raise InputError(f"{path}: does not contain a finished run {run.id}")
    run.metrics()
    listed = read_json(run.marker).get("artifacts")
    if not isinstance(listed, dict) or not listed:
        raise InputError(f"{path}: its run does not have digests of its artifacts")
    if changed := run.verify():
        raise InputError(f"{path}: changed since it was made: {', '.join(changed)}")
