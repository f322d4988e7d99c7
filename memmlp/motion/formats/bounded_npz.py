"""Reads arrays of an npz within fixed bounds of memory, whatever the file says of itself.

An npz is a zip of npy files. Before an array is allocated, its header must agree with its size in the zip's
directory and with the bounds below. It is read in blocks, and only the first columns of a wide array are
kept. Nothing is ever unpickled. The exceptions that `zipfile` and `numpy.lib.format` raise for damaged bytes
are not documented (among others tokenize.TokenError, RecursionError, struct.error), so any exception of
theirs means a bad file.
"""

from __future__ import annotations

import io
import math
import os
import warnings
import zipfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from memmlp.common.errors import InputError

BLOCK = 2**23  # the most bytes in a read; the zip's directory must fit into one
MAX_HEADER = 10_000  # bytes of an npy header, as in np.load
MAX_ROWS = 500_000  # frames: an hour at 120 Hz is 432,000
MAX_SCALAR = 1_024  # bytes of an array that is one number or word
MAGIC = b"PK"
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # NumPy's; others unpack without a bound


@dataclass(frozen=True)
class Header:
    """The header of an npy file, which describes its array.

    Attributes:
        shape: the array's shape.
        fortran: whether the array is stored column by column.
        dtype: the type of its numbers.
        offset: bytes before its data.
    """

    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype
    offset: int

    def __str__(self) -> str:
        return f"{self.dtype} {self.shape}"

    @property
    def size(self) -> int:
        """Bytes of the array's data."""
        return math.prod(self.shape) * self.dtype.itemsize


class Npz:
    """An npz that is open for reading (`open_npz`)."""

    def __init__(self, path: Path, archive: zipfile.ZipFile) -> None:
        self.path = path
        self._zip = archive
        self.names = {name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")}

    def header(self, name: str) -> Header:
        """Return an array's header, after a check that the zip's directory agrees with it."""
        info = self._zip.getinfo(f"{name}.npy")
        if info.compress_type not in METHODS:
            raise InputError(
                f"{self.path}: {name} is packed by method {info.compress_type}; allowed: stored, deflate"
            )
        with self._zip.open(info) as entry:
            header = _parse_header(entry.read(MAX_HEADER))
        if min(header.shape, default=0) < 0 or header.offset + header.size != info.file_size:
            raise InputError(
                f"{self.path}: {name} is {header}, which does not fit its {info.file_size} bytes in the zip"
            )
        return header

    def scalar(self, name: str) -> np.ndarray:
        """Read a small array whole."""
        header = self.header(name)
        if header.size > MAX_SCALAR:
            raise InputError(f"{self.path}: {name} is {header}, not one number")
        with self._entry(name, header) as entry:
            return np.frombuffer(entry.read(), header.dtype).reshape(header.shape)

    def columns(self, name: str, count: int, widths: Collection[int]) -> np.ndarray:
        """Read the first `count` columns of an array of numbers (N, >= count), or (N, J, 3), as float64.

        The array must have as many columns as `widths` allow.

        Raises:
            InputError: for other shapes or types, no rows, or more rows or columns than allowed.
        """
        header = self.header(name)
        rows, width = self._check(name, header, widths)
        columns = np.empty((rows, count))
        with self._entry(name, header) as entry:
            if header.fortran:
                for start, block in _lines(entry, header.dtype, width, rows):
                    some = block[: max(0, count - start)]
                    columns[:, start : start + len(some)] = some.T
            else:
                for start, block in _lines(entry, header.dtype, rows, width):
                    columns[start : start + len(block)] = block[:, :count]
        return columns

    def _check(self, name: str, header: Header, widths: Collection[int]) -> tuple[int, int]:
        """Return rows and width of an array, after a check that it may be read."""
        shape = header.shape
        flat = len(shape) == 2 or (len(shape) == 3 and shape[2] == 3 and not header.fortran)
        rows, width = (shape[0], math.prod(shape[1:])) if flat else (0, 0)
        if header.dtype.kind != "f" or width not in widths:
            allowed = " or ".join(f"(N, {width})" for width in widths)
            raise InputError(f"{self.path}: {name} is {header}, not floats {allowed}")
        if rows == 0:
            raise InputError(f"{self.path}: no frames")
        if rows > MAX_ROWS:
            raise InputError(f"{self.path}: {name} is {header}; allowed: up to {MAX_ROWS} frames")
        return rows, width

    @contextmanager
    def _entry(self, name: str, header: Header) -> Iterator[IO[bytes]]:
        """Open an array's bytes where its data begin."""
        with self._zip.open(f"{name}.npy") as entry:
            entry.seek(header.offset)
            yield entry


@contextmanager
def open_npz(path: Path) -> Iterator[Npz]:
    """Open an npz; damaged bytes raise InputError, here and while the file is read.

    Raises:
        InputError: if the file cannot be opened, is no zip, or is damaged; the message names it.
    """
    try:
        with open(path, "rb") as raw:
            magic = raw.read(len(MAGIC))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if magic != MAGIC:
        raise InputError(f"{path}: no zip, so no npz (memmlp data import makes one of BVH)")
    try:
        with _Bounded(io.FileIO(path)) as file, zipfile.ZipFile(file) as archive:
            yield Npz(path, archive)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{path}: not a readable npz ({brief(error)})") from error


def brief(error: Exception) -> str:
    """Shorten an exception's message to a few words on one line."""
    return " ".join(str(error).split())[:120] or type(error).__name__


class _Bounded(io.BufferedReader):
    """A file that is read at most a block at a time, so that no zip directory can fill the memory."""

    def read(self, size: int | None = -1, /) -> bytes:
        """Read `size` bytes, or all; raise ValueError if that is more than a block."""
        left = os.fstat(self.fileno()).st_size - self.tell()
        wanted = min(left, size) if size is not None and size >= 0 else left
        if wanted > BLOCK:
            raise ValueError(f"a part of more than {BLOCK >> 20} MiB")
        return super().read(max(0, wanted))


def _parse_header(start: bytes) -> Header:
    """Parse an npy header from the first bytes of its file; any exception means that it is none."""
    stream = io.BytesIO(start)
    version = np.lib.format.read_magic(stream)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"an npy header of version {version}")
    with warnings.catch_warnings():  # of headers that Python 2 wrote, and of odd escapes in them
        warnings.simplefilter("ignore")
        shape, fortran, dtype = readers[version](stream, max_header_size=MAX_HEADER)
    return Header(shape, fortran, dtype, stream.tell())


def _lines(entry: IO[bytes], dtype: np.dtype, count: int, length: int) -> Iterator[tuple[int, np.ndarray]]:
    """Yield `count` lines of `length` numbers in blocks (n, length), each with its first line's index."""
    step = max(1, BLOCK // (length * dtype.itemsize))
    for start in range(0, count, step):
        lines = min(step, count - start)
        data = entry.read(lines * length * dtype.itemsize)
        yield start, np.frombuffer(data, dtype).reshape(lines, length)
