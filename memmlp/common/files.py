"""Atomic writing of files, and JSON with NaN and infinities.

JSON does not have NaN and infinities, so they are stored as the strings "nan", "inf" and "-inf".
"""

import contextlib
import hashlib
import json
import math
import os
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO

import memmlp
from memmlp.common.lease import publish_at_end


def find_packaged_folder(name: str) -> Path:
    """Return the shipped folder `conf`, `sweeps` or `models`.

    In a checkout, it is beside the package folder. In an installation, it is `_conf`, `_sweeps` or `_models`
    inside the package folder.
    """
    package = Path(memmlp.__file__).resolve().parent
    installed = package / f"_{name}"
    return installed if installed.is_dir() else package.parent / name


def now() -> str:
    """Return the current time in UTC, to the second, in ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def to_number(value: Any) -> Any:
    """Convert the strings "nan", "inf" and "-inf" back to numbers; return other values unchanged."""
    return float(value) if value in ("nan", "inf", "-inf") else value


def is_number(value: Any) -> bool:
    """Return whether a value is an int or a float; a bool is not a number."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def make_json_safe(value: Any) -> Any:
    """Return the value in a form that can be stored as JSON: tuples become lists, and keys, NaN and
    infinities strings."""
    if isinstance(value, Mapping):
        return {str(key): make_json_safe(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [make_json_safe(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def atomic_write(path: Path, content: bytes | str) -> None:
    """Write a file completely or not at all (`atomic_file`)."""
    with atomic_file(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file for writing under a temporary name; it is synced and renamed once it is complete, even if
    the machine crashes. Raises LeaseLost if this process lost its lease of the file's folder."""
    with publish_at_end(path) as unfinished, naming_file(path), open(unfinished, "wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())
    sync_folder(path.parent)


@contextlib.contextmanager
def naming_file(path: Path) -> Iterator[None]:
    """Add the path to an OSError that does not name a file, such as a full disk in `write`."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise


def write_json(path: Path, value: Any) -> None:
    """Write JSON atomically; the keys keep their order."""
    atomic_write(path, json.dumps(make_json_safe(value), indent=2, allow_nan=False) + "\n")


def sync_folder(folder: Path) -> None:
    """Make the renames and removals in a folder durable."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest(value: Any) -> str:
    """Return the SHA-256 digest (hex) of a JSON value; other values count as text."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()


def read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file; empty if the file is missing or not valid JSON."""
    try:
        value = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}
