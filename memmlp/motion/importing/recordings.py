"""Finds and reads recordings, and finds their true frame rates. To add a format, write a module in
`memmlp.motion.formats` with a function `read(path) -> Recording`, and add it to `READERS`."""

import csv
import hashlib
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

import yaml

from memmlp.common.errors import InputError, describe_read_error
from memmlp.common.progress import notify
from memmlp.motion.clip import FRAME_RATE_RANGE
from memmlp.motion.formats.asf_amc import read_amc
from memmlp.motion.formats.bvh import read_bvh
from memmlp.motion.formats.recording import Recording
from memmlp.motion.preparing.find_clips import FolderContent, find_files

READERS: dict[str, Callable[[Path], Recording]] = {".bvh": read_bvh, ".amc": read_amc}
EXPECTED = f"expected a {' or '.join(READERS)} file, or a folder with such files"
INDEX = "*index.csv"
COLUMNS = "Subject", "Trial #", "framerate"  # of the CMU database's index
DIGITS = 16  # number of digits of a file's digest in known_rates.yaml


class Rate(NamedTuple):
    """A frame rate, Hz, and where it comes from, for messages."""

    fps: float
    reason: str


DATABASES = Rate(120.0, "the rate of CMU and HDM05, because AMC files do not have a rate")


def find_recordings(source: Path) -> dict[Path, Path]:
    """Find the recordings of a folder, or a single recording: path below the folder -> path, sorted. Linked
    folders are searched as in `find_files`. Raises InputError if the folder or file is missing, or the folder
    has no recordings."""
    if not source.exists():
        raise InputError(f"{source}: no such file or folder; {EXPECTED}")
    content = find_files(source, *READERS) if source.is_dir() else FolderContent([source.name])
    top = source if source.is_dir() else source.parent
    for folder, reason in content.unreadable.items():
        notify(f"{top / folder}: {reason}")
    paths = {Path(file): top / file for file in content.files}
    files = {name: path for name, path in paths.items() if path.suffix.lower() in READERS and path.is_file()}
    if not files:
        raise InputError(f"{source}: no recording found; {EXPECTED}")
    return files


def read_recording(path: Path) -> Recording:
    """Read a recording. Raises InputError if the file is damaged or has an unknown format."""
    if path.suffix.lower() not in READERS:
        raise InputError(f"{path}: {EXPECTED}")
    return READERS[path.suffix.lower()](path)


def find_rate(recording: Recording, relative: Path, user_rates: Mapping[str, float]) -> Rate:
    """Find the true frame rate: the user's (folder below the imported one, "" for all -> Hz), a known file's,
    the index's, the header's, or else 120 Hz. An index is a CSV file `*index.csv` in the file's folder, or in
    one above it up to the imported folder. It has the columns of the CMU database's index; its row of a file
    is found by the name `SUBJECT_TRIAL`. Raises InputError if an index is damaged."""
    for folder in relative.parents:
        if (key := make_folder_key(folder)) in user_rates:
            return Rate(float(user_rates[key]), f"set for {key or 'all'}")
    plain = recording.path.read_bytes().replace(b"\r\n", b"\n")  # ignore differences in line ends
    known = _load_known_rates().get(hashlib.sha256(plain).hexdigest()[:DIGITS])
    if known is not None:
        return Rate(known, "the known true rate of this file")
    for folder in recording.path.parents[: len(relative.parents)]:
        for path in sorted(folder.glob(INDEX)):
            if (rate := _read_index(path).get(recording.path.stem)) is not None:
                return Rate(rate, f"the rate in {path.name}")
    return DATABASES if recording.fps is None else Rate(recording.fps, "the header's")


def make_folder_key(folder: Path) -> str:
    """Return a folder's name in `--fps`, relative to the imported folder; "" for the imported folder."""
    return "" if folder == Path() else folder.as_posix()


@cache
def _read_index(path: Path) -> dict[str, float]:
    """Read an index: name of a file, such as `05_01` -> its rate, Hz."""
    rates: dict[str, float] = {}
    low, high = FRAME_RATE_RANGE
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            for row in (rows := csv.DictReader(file)):
                subject, trial, rate = (row[column] for column in COLUMNS)
                rates[f"{int(subject):02}_{int(trial):02}"] = float(rate)
                if not low <= float(rate) <= high:
                    raise ValueError
    except KeyError as error:
        raise InputError(f"{path}: has no column {error}; must have {', '.join(COLUMNS)}") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: {describe_read_error(error)}; expected a CSV file") from None
    except (TypeError, ValueError):
        expected = f"numbers in {', '.join(COLUMNS)}, and a rate of {low:g} to {high:g} Hz"
        raise InputError(f"{path}: line {rows.line_num}: must have {expected}") from None
    return rates


@cache
def _load_known_rates() -> dict[str, float]:
    path = Path(__file__).with_name("known_rates.yaml")
    return {digest: float(fps) for digest, fps in yaml.safe_load(path.read_text("utf-8")).items()}
