"""Atomic writing of files, and JSON that can hold every number.

JSON has no NaN and infinities, so they are stored as the strings "nan", "inf" and "-inf".
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO

from memmlp.common.lease import publish, temporary


def now() -> str:
    """Return the current time in UTC, to the second, in ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def to_number(value: Any) -> Any:
    """Convert NaN and infinities, which JSON holds as strings, back to numbers; other values stay."""
    return float(value) if value in ("nan", "inf", "-inf") else value


def plain(value: Any) -> Any:
    """Return the value in a form that JSON can hold.

    Tuples become lists, keys become strings, and NaN and infinities become strings.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def atomic_write(path: Path, content: bytes | str) -> None:
    """Write a file completely or not at all, as `atomic_file` does."""
    with atomic_file(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file for writing that will be complete or absent, even if the machine stops.

    It is written under a temporary name, then synced and renamed.

    Raises:
        LeaseLost: if this process held the file's folder and has lost it (memmlp.common.lease).
    """
    unfinished = temporary(path)
    try:
        with open(unfinished, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        publish(unfinished, path)
    except BaseException:
        with contextlib.suppress(OSError):  # the disk may refuse this, too; the first error says why
            unfinished.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def write_json(path: Path, value: Any) -> None:
    """Write JSON atomically, with the keys in the order given."""
    atomic_write(path, json.dumps(plain(value), indent=2, allow_nan=False) + "\n")


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
    """Return the SHA-256 digest (hex) of a value that JSON can hold.

    A value that JSON can't hold is converted to text, so a dataclass has to be given as its `asdict`.
    """
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()


def read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file, or an empty one if the file is missing or does not parse."""
    try:
        value = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return value if isinstance(value, dict) else {}
