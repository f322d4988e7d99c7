"""Exports a run to one file and imports it: a zip with the run's folder, named by the run's id.

Archives are not trusted: only names of run files are accepted, nothing is executed or unpickled, and the run
is moved to the outputs folder only if it is complete and matches the digests in its files."""

import errno
import os
import re
import shutil
import struct
import tempfile
import zipfile
import zlib
from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_file, file_digest, naming_file, sync_folder
from memmlp.runs import records
from memmlp.runs.identity import ID
from memmlp.runs.run import Run

MAX_FILES = 1000
MAX_SIZE = 4 * 10**9  # default limit for the total size of all files, bytes
METHODS = zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED  # others do not limit the unpacked size
PART = r"\w[\w.-]{0,99}"  # a folder or file name; not ".."
PATTERNS = {*Run.FILES, "notes.json", "DONE"} - {"FAILED", "STOP", "PRIORITY"}
ALLOWED = re.compile("|".join(re.escape(pattern).replace(r"\*", PART) for pattern in sorted(PATTERNS)))
"""The files that an archive may contain."""


def export_run(run: Run, out: Path) -> str:
    """Write a finished run, without its checkpoint, to an archive; return the archive's SHA-256. Raises
    InputError if the run is not finished, or if files are missing, damaged or have changed."""
    if not run.done:
        raise InputError(f"run {run.id}: must be finished; its status is {run.status}")
    run.check_records()
    if changed := run.verify():
        raise InputError(f"run {run.id}: must be unchanged; missing or changed files: {', '.join(changed)}")
    run_files = [path for pattern in run.FILES for path in sorted(run.folder.glob(pattern))]
    paths = [*run_files, run.notes_path, run.marker]
    files = {path.relative_to(run.folder).as_posix(): path for path in paths}
    out.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(out) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, path in files.items():
            if ALLOWED.fullmatch(name) and path.is_file() and path != run.checkpoint:
                archive.write(path, f"{run.id}/{name}")
    return file_digest(out)


def import_run(
    path: Path, outputs: Path, sha256: str | None = None, max_size: int = MAX_SIZE
) -> tuple[Run, bool]:
    """Add the run in an archive to an outputs folder; return the run, and whether it is new. An existing run
    with the same weights is left unchanged. `sha256` is the required digest, `max_size` the allowed total
    size of all files, bytes. Raises InputError if the file is not an archive of a run, is too large, or a
    digest is wrong."""
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if sha256 is not None and file_digest(path) != sha256.lower():
        raise InputError(f"{path}: must have the SHA-256 {sha256}, but has {file_digest(path)}")
    try:
        with zipfile.ZipFile(path) as archive:
            return _move_to_runs(archive, path, _check_names(archive, path, max_size), outputs)
    except InputError:
        raise
    except OSError as error:
        if error.errno != errno.EINVAL:  # a position outside the file
            raise
        raise InputError(f"{path}: must be an archive of a run ({error.strerror})") from None
    except (zipfile.BadZipFile, zlib.error, struct.error, RuntimeError, EOFError, ValueError) as error:
        raise InputError(f"{path}: must be an archive of a run ({error})") from None


def _check_names(archive: zipfile.ZipFile, path: Path, max_size: int) -> str:
    every = archive.namelist()
    run_id = every[0].partition("/")[0] if every else ""
    if len(every) > MAX_FILES:
        raise InputError(f"{path}: must be an archive of a run with at most {MAX_FILES} files")
    if len(set(every)) != len(every) or not ID.fullmatch(run_id):
        raise InputError(f"{path}: must be an archive with one run folder, named by 16 hex digits")
    for name in every:
        folder, _, file = name.partition("/")
        if folder != run_id or not ALLOWED.fullmatch(file):
            raise InputError(f"{path}: {name!r} is not a file of run {run_id}")
    if any(one.compress_type not in METHODS for one in archive.infolist()):
        raise InputError(f"{path}: must be stored or deflated, as memmlp runs export does")
    if (total := sum(one.file_size for one in archive.infolist())) > max_size:
        raise InputError(f"{path}: must be at most {max_size / 1e9:.1f} GB (--max-gb), not {total / 1e9:.1f}")
    return run_id


def _move_to_runs(archive: zipfile.ZipFile, path: Path, run_id: str, outputs: Path) -> tuple[Run, bool]:
    place = Run.from_id(outputs, run_id)
    place.folder.parent.mkdir(parents=True, exist_ok=True)
    staging = Path(tempfile.mkdtemp(dir=place.folder.parent, prefix=".import-"))
    try:
        with naming_file(place.folder):
            archive.extractall(staging)
        run = Run(staging / run_id)
        _check_unpacked_run(run, path)
        if not place.folder.exists():
            os.rename(run.folder, place.folder)
            sync_folder(place.folder.parent)
            return place, True
        weights = file_digest(run.model)
        if not place.done or not place.model.is_file() or file_digest(place.model) != weights:
            raise InputError(f"{path}: run {place.id} already exists ({place.status}) with different weights")
        return place, False
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _check_unpacked_run(run: Run, path: Path) -> None:
    if damage := run.damage:
        raise InputError(f"{path}: {damage[0].removeprefix(f'{run.folder}/')}")
    if not run.done or run.manifest.get("id") != run.id or not run.config:
        raise InputError(f"{path}: must contain a finished run {run.id}")
    run.metrics()
    if not records.read(run.marker, records.Marker).get("artifacts"):
        raise InputError(f"{path}: {run.marker.name} must contain the digests of the run's artifacts")
    if changed := run.verify():
        raise InputError(f"{path}: must be an unchanged run; missing or changed files: {', '.join(changed)}")
