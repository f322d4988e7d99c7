"""The index of all runs below an outputs folder: parsed again when files change, stored between starts."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import sqlite3
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from memmlp.report.ui import run_row
from memmlp.runs.identity import ID
from memmlp.runs.run import Run

FORMAT = hashlib.sha256(Path(run_row.__file__).read_bytes()).hexdigest()[:16]
"""A digest of the code that makes facts; stored facts from other code are made again."""

FILES = ("config.yaml", "manifest.json", "metrics.jsonl", "DONE", "FAILED", "results.json", "notes.json")
FOLDERS = ("evaluations", "deployments")


class Index:
    """The facts of all runs.

    Attributes:
        outputs: the folder of runs and caches.
        generation: a number that grows with every change.
        runs: the facts by run id, including the run's `status` and the `generation` of its last change.
        removed: the ids of deleted runs, with the generation in which they disappeared.

    Args:
        outputs: the folder of runs and caches.
        store: the file in which facts are stored between starts; None to store none.
    """

    def __init__(self, outputs: Path, store: Path | None = None):
        self.outputs, self.generation = outputs, 0
        self.runs: dict[str, dict[str, Any]] = {}
        self.removed: dict[str, int] = {}
        self.signatures: dict[str, str] = {}
        self.lock = threading.RLock()
        self.store = Store(store) if store else None
        if self.store:
            for run_id, signature, found in self.store.load():
                self.runs[run_id], self.signatures[run_id] = found, signature

    def refresh(self) -> int:
        """Look at all run folders again, and return the generation."""
        with self.lock:
            seen = {folder.name: folder for folder in self._folders()}
            following = self.generation + 1
            changed = [run_id for run_id, folder in seen.items() if self._renew(run_id, folder, following)]
            gone = [run_id for run_id in self.runs if run_id not in seen]
            for run_id in gone:
                del self.runs[run_id], self.signatures[run_id]
                self.removed[run_id] = following
            if changed or gone:
                self.generation = following
            return self.generation

    def _folders(self) -> Iterator[Path]:
        with (
            contextlib.suppress(FileNotFoundError, NotADirectoryError),
            os.scandir(self.outputs / "runs") as entries,
        ):
            for entry in entries:
                if ID.fullmatch(entry.name) and entry.is_dir():
                    yield Path(entry.path)

    def _renew(self, run_id: str, folder: Path, generation: int) -> bool:
        """Update a run's facts, and return whether they changed."""
        signature = _signature(folder)
        known = self.runs.get(run_id)
        if known is None or self.signatures.get(run_id) != signature:
            known = run_row.facts(folder)
            self.signatures[run_id] = signature
            if self.store:
                self.store.put(run_id, signature, known)
            known["status"] = None
        complete = known["complete"] and not known["failure"]
        status = "done" if complete and not _claimed(folder) else _status(folder)
        if known.get("status") == status and run_id in self.runs and "generation" in known:
            return False
        self.removed.pop(run_id, None)
        self.runs[run_id] = {**known, "status": status, "generation": generation}
        return True

    def keep(self) -> None:
        """Write the facts that were parsed since the last call into the store."""
        with self.lock:
            if self.store:
                self.store.commit(set(self.runs))


def _status(folder: Path) -> str:
    """Return a run's status: its progress, or what a process is doing with it."""
    try:
        return Run(folder).status
    except (KeyError, ValueError, TypeError, AttributeError):  # somebody's damaged .holder
        return "stopped"


def _claimed(folder: Path) -> bool:
    """Return whether a process may be working on a run, as its folder has a claim that is not free."""
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        return any(re.fullmatch(r"\.lease-\d+", entry.name) for entry in entries)
    return False


def _signature(folder: Path) -> str:
    """Return a text that changes when any file changes from which a run's facts come."""
    parts = _stats(folder, FILES)
    for name in FOLDERS:
        parts += _stats(folder / name)
    for deployment in _names(folder / "deployments"):
        parts += _stats(folder / "deployments" / deployment, ("latency.json",))
    return hashlib.sha256(repr(sorted(parts)).encode()).hexdigest()[:20]


def _names(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)
    except OSError:
        return []


def _stats(folder: Path, names: tuple[str, ...] | None = None) -> list[tuple[str, str, int, int]]:
    """Return name, time and size of a folder's files, either of certain names or all."""
    found = []
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if (names is None or entry.name in names) and not entry.name.startswith("."):
                    stat = entry.stat()
                    found.append((folder.name, entry.name, stat.st_mtime_ns, stat.st_size))
    except OSError:  # it is gone, or is being written
        pass
    return found


class Store:
    """Facts in an sqlite file, which may be removed at any time; if it can't be used, nothing is stored."""

    def __init__(self, path: Path):
        self.path = path
        self.fresh: dict[str, tuple[str, str]] = {}

    def load(self) -> list[tuple[str, str, dict[str, Any]]]:
        """Return id, signature and facts of each stored run."""
        try:
            with contextlib.closing(self._open()) as database:
                rows = database.execute(
                    "SELECT id, signature, facts FROM runs WHERE format = ?", (FORMAT,)
                ).fetchall()
            return [(run_id, signature, json.loads(text)) for run_id, signature, text in rows]
        except (sqlite3.Error, ValueError, OSError):
            with contextlib.suppress(OSError):
                self.path.unlink()
            return []

    def put(self, run_id: str, signature: str, found: dict[str, Any]) -> None:
        """Remember a run's facts for the next `commit`."""
        self.fresh[run_id] = (signature, json.dumps(found))

    def commit(self, known: set[str]) -> None:
        """Write what was put since the last time, and remove runs that no longer exist."""
        if not self.fresh:
            return
        rows = [(run_id, FORMAT, *row) for run_id, row in self.fresh.items()]
        try:
            with contextlib.closing(self._open()) as database, database:
                database.executemany("INSERT OR REPLACE INTO runs VALUES (?, ?, ?, ?)", rows)
                gone = {row[0] for row in database.execute("SELECT id FROM runs")} - known
                database.executemany("DELETE FROM runs WHERE id = ?", [(one,) for one in gone])
        except (sqlite3.Error, OSError):
            return  # another page's server is at it, or the folder is read-only
        self.fresh.clear()

    def _open(self) -> sqlite3.Connection:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        database = sqlite3.connect(self.path, timeout=2)
        database.execute(
            "CREATE TABLE IF NOT EXISTS runs (id TEXT PRIMARY KEY, format TEXT, signature TEXT, facts TEXT)"
        )
        return database
