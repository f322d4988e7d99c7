"""A run as one file: a zip of its own files, with an index of their sizes and digests.

An archive is not trusted. It is unpacked into a folder beside the runs. Only names of a run's files are
accepted, and each file must have the size and the digest in the index; nothing is executed or unpickled. Only
a complete run is then moved among the runs.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any

from memmlp.common.errors import InputError
from memmlp.common.files import file_digest, read_json, sync_folder
from memmlp.runs.identity import ID
from memmlp.runs.notes import notes_path
from memmlp.runs.run import Run

FORMAT = "memmlp run 1"
INDEX = "index.json"
MAX_INDEX = 2**20  # bytes
MAX_FILES = 1000
MAX_SIZE = 4 * 10**9  # bytes of all files together, by default
PIECE = 2**20
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
    names = {path.relative_to(run.folder).as_posix(): path for path in (*own, notes_path(run), run.marker)}
    files = {
        name: path
        for name, path in names.items()
        if ALLOWED.fullmatch(name) and path.is_file() and path != run.checkpoint
    }
    index = {name: {"size": path.stat().st_size, "sha256": file_digest(path)} for name, path in files.items()}
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=out.parent, prefix=f".{out.name}.", delete=False) as temporary:
        try:
            with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
                archive.writestr(
                    INDEX, json.dumps({"format": FORMAT, "run": run.id, "files": index}, indent=1)
                )
                for name, path in files.items():
                    archive.write(path, name)
            temporary.flush()
            os.fsync(temporary.fileno())
            os.replace(temporary.name, out)
        except BaseException:
            Path(temporary.name).unlink(missing_ok=True)
            raise
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
            run_id, files = _index(archive, path, largest)
            run, new = _placed(archive, path, run_id, files, outputs)
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not an archive of a run ({error})") from None
    missing = (name for name in files if "/" in name and not (run.folder / name).exists())
    if not new and (more := sorted({"/".join(name.split("/")[:2]) for name in missing})):
        tell(f"{path}: also has {', '.join(more)}, which is not added to run {run.id}")
    return run, new


def _index(archive: zipfile.ZipFile, path: Path, largest: int) -> tuple[str, Mapping[str, Mapping[str, Any]]]:
    """Return the run's id and the files in the index, after a check of names and sizes."""
    names = archive.namelist()
    if len(names) > MAX_FILES or len(set(names)) != len(names) or INDEX not in names:
        raise InputError(f"{path}: not an archive of a run: it must have {INDEX} and each name once")
    with archive.open(INDEX) as file:
        text = file.read(MAX_INDEX + 1)
    if len(text) > MAX_INDEX:
        raise InputError(f"{path}: its {INDEX} is larger than {MAX_INDEX} bytes")
    found = json.loads(text)
    if not isinstance(found, dict) or found.get("format") != FORMAT or not _sound(found.get("files")):
        raise InputError(f"{path}: its {INDEX} must have the format '{FORMAT}'")
    run_id, files = found.get("run"), found["files"]
    if not isinstance(run_id, str) or not ID.fullmatch(run_id):
        raise InputError(f"{path}: its run id must be 16 hex digits")
    if other := sorted({*names} ^ {*files, INDEX}):
        raise InputError(f"{path}: {other[0]!r} must be both in the archive and in its index")
    if bad := [name for name in files if not ALLOWED.fullmatch(name)]:
        raise InputError(f"{path}: {bad[0]!r} is not a file of a run")
    if (total := sum(one["size"] for one in files.values())) > largest:
        raise InputError(f"{path}: {total / 1e9:.1f} GB; must be at most {largest / 1e9:.1f} (--max-gb)")
    return run_id, files


def _sound(files: Any) -> bool:
    """Return whether the index has a valid size and digest for each file."""
    return isinstance(files, dict) and all(
        isinstance(one, dict)
        and isinstance(one.get("size"), int)
        and one["size"] >= 0
        and isinstance(one.get("sha256"), str)
        for one in files.values()
    )


def _placed(
    archive: zipfile.ZipFile, path: Path, run_id: str, files: Mapping[str, Mapping[str, Any]], outputs: Path
) -> tuple[Run, bool]:
    """Unpack into a folder beside the runs, check the run there, and move it to its place."""
    place = Run.of(outputs, run_id)
    if place.folder.exists():
        return _known(place, files, path), False
    place.folder.parent.mkdir(parents=True, exist_ok=True)
    staging = Path(tempfile.mkdtemp(dir=place.folder.parent, prefix=".import-"))
    try:
        folder = staging / run_id
        for name, expected in files.items():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            with archive.open(name) as source, open(target, "xb") as file:
                _copy(source, file, expected, f"{path}: {name}")
        _check(Run(folder), path)
        try:
            os.rename(folder, place.folder)
        except OSError:  # another process was quicker
            if place.done:
                return _known(place, files, path), False
            raise
        sync_folder(place.folder.parent)
        return place, True
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _copy(source: IO[bytes], file: IO[bytes], expected: Mapping[str, Any], what: str) -> None:
    """Copy the expected number of bytes. Raises InputError if there are more, or if the digest is wrong."""
    digest, left = hashlib.sha256(), expected["size"]
    while piece := source.read(min(PIECE, left + 1)):
        left -= len(piece)
        if left < 0:
            break
        digest.update(piece)
        file.write(piece)
    if left or digest.hexdigest() != expected["sha256"]:
        raise InputError(f"{what}: its digest is wrong; copy the archive again")
    file.flush()
    os.fsync(file.fileno())


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


def _known(place: Run, files: Mapping[str, Mapping[str, Any]], path: Path) -> Run:
    """Return the run that exists already. Raises InputError if it is not the archive's run."""
    weights = files.get(place.model.name, {}).get("sha256")
    if not place.done or not place.model.is_file() or file_digest(place.model) != weights:
        raise InputError(f"{path}: run {place.id} exists already ({place.status}) with other weights")
    return place
