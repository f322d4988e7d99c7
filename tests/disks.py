"""Disks that refuse to be written to, from a certain write on."""

from __future__ import annotations

import builtins
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


class Disk:
    """The disk below a folder. It counts what is written to it, and is full from write number `full` on.

    Args:
        monkeypatch: undoes it.
        folder: the folder.
        code: the error that a refused write gives.
        full: the number of the first write that is refused; None for none.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path, code: int, full: int | None = None):
        self.folder, self.code, self.full, self.writes = str(folder), code, full, 0
        for name in ("open", "mkdir"):
            monkeypatch.setattr(os, name, self._os(getattr(os, name)))
        real = builtins.open

        def opened(path: Any, mode: str = "r", *arguments: Any, **options: Any) -> Any:
            if not set(mode) & set("wax+") or not self._has(path):
                return real(path, mode, *arguments, **options)
            self.write(path)
            return Written(self, path, real(path, mode, *arguments, **options))

        monkeypatch.setattr(builtins, "open", opened)

    def _has(self, path: Any) -> bool:
        return isinstance(path, str | os.PathLike) and os.path.abspath(path).startswith(self.folder)

    def _os(self, call: Callable[..., Any]) -> Callable[..., Any]:
        """Return os.mkdir or os.open, which writes where it creates."""

        def called(path: Any, flags: int = os.O_CREAT, *arguments: Any, **options: Any) -> Any:
            if flags & os.O_CREAT and self._has(path) and not os.path.exists(path):
                self.write(path)
            return call(path, flags, *arguments, **options)

        return called

    def write(self, path: Any) -> None:
        """Count a write, or refuse it."""
        if self.full is not None and self.writes >= self.full:
            raise OSError(self.code, os.strerror(self.code), str(path))
        self.writes += 1


class Written:
    """A file being written to a disk. Of what is refused, half is written."""

    def __init__(self, disk: Disk, path: Any, file: Any):
        self.disk, self.path, self.file = disk, path, file

    def write(self, content: Any) -> int:
        """Write, or write half and raise; an unbuffered file writes half and returns how much that was."""
        try:
            self.disk.write(self.path)
        except OSError:
            half = self.file.write(content[: len(content) // 2])
            if hasattr(self.file, "raw") or not half:
                raise
            return half
        return self.file.write(content)

    def __enter__(self) -> Written:
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.file, name)
