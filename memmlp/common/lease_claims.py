"""Claims on a folder: numbered files, of which only one process can make each."""

from __future__ import annotations

import contextlib
import json
import os
import re
import uuid
from pathlib import Path
from typing import Any, NamedTuple

from memmlp.common.liveness import lives


class Claim(NamedTuple):
    """A claim on a folder, as it was read.

    Attributes:
        number: the claim's number.
        text: the content of the claim's file.
        touched: when the file was last touched, nanoseconds of the file system's clock.
    """

    number: int
    text: str
    touched: int

    @property
    def owner(self) -> dict[str, Any] | None:
        """The process that made the claim; empty for nobody, None if that cannot be read.

        An empty file is nobody's. A process that writes into it later (see Claims.make) is stopped by the
        fence (memmlp.common.lease_fences).
        """
        try:
            found = json.loads(self.text or "{}")
        except ValueError:
            return None
        return found if isinstance(found, dict) else None

    @property
    def free(self) -> bool:
        """Whether the claim belongs to nobody."""
        return self.owner == {}

    @property
    def lives(self) -> bool | None:
        """Whether its owner is a living process on this machine; None for another one, or if not known."""
        return lives(self.owner) if self.owner else None


class Claims:
    """The claims on a folder: files whose names begin with `prefix` and end with a number."""

    def __init__(self, folder: Path, prefix: str):
        self.folder, self.prefix = folder, prefix
        self.pattern = re.compile(re.escape(prefix) + r"(\d+)$")

    def path(self, number: int) -> Path:
        """Return the file of a claim."""
        return self.folder / f"{self.prefix}{number}"

    def numbers(self) -> list[int]:
        """Return the numbers of all claims, in ascending order."""
        try:
            found = map(self.pattern.match, os.listdir(self.folder))
        except FileNotFoundError:
            return []
        return sorted(int(match[1]) for match in found if match)

    def last(self) -> Claim | None:
        """Return the last claim, which is the valid one; None if there was never any."""
        while numbers := self.numbers():
            with contextlib.suppress(FileNotFoundError):  # it has been superseded meanwhile
                return self._read(numbers[-1])
        return None

    def _read(self, number: int) -> Claim:
        with open(self.path(number), encoding="utf-8") as file:  # on NFS opening it asks the server
            return Claim(number, file.read(), os.fstat(file.fileno()).st_mtime_ns)

    def make(self, number: int, owner: dict[str, Any] | None = None) -> bool:
        """Make a claim, by default nobody's, and return whether no other process had made it before.

        An owner's claim is a link to a finished file, so that no other process sees it empty, which would
        mean nobody's. If links are not supported, the file is written after it is made.
        """
        text = json.dumps(owner) if owner else ""
        if not text:
            return _write_new(self.path(number), text)
        draft = self._draft(number)
        _write_new(draft, text)
        try:
            os.link(draft, self.path(number))
        except (FileExistsError, FileNotFoundError):  # a server may have made the link and lost its answer
            return _links(draft) > 1
        except OSError:
            return _write_new(self.path(number), text)
        finally:
            draft.unlink(missing_ok=True)
        return True

    def _draft(self, number: int) -> Path:
        """Return a unique name for a claim that is being made, under which the next owner can remove it."""
        stem = self.prefix.removesuffix("lease-")
        return self.folder / f"{stem}claim.lease-{number}.{uuid.uuid4().hex[:12]}.tmp"

    def remove_below(self, number: int) -> None:
        """Remove superseded claims in ascending order: if cut short, it leaves no earlier one as the last."""
        for old in self.numbers():
            if old < number:
                self.path(old).unlink(missing_ok=True)


def _write_new(path: Path, text: str) -> bool:
    """Write a new file; return False if it exists already."""
    try:
        handle = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
    except FileExistsError:
        return False
    try:
        os.write(handle, text.encode())
    finally:
        os.close(handle)
    return True


def _links(path: Path) -> int:
    """Return how many names a file has; 0 if it is gone."""
    try:
        return os.stat(path).st_nlink
    except FileNotFoundError:
        return 0
