"""Run folders: lock, manifest, metrics log, completion. The folder is the truth; nothing else is."""

from __future__ import annotations

import contextlib
import json
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from filelock import FileLock, Timeout

from memmlp.environment import environment, host
from memmlp.errors import InputError
from memmlp.files import atomic_write, file_digest, plain, read_json, sync_folder, write_json
from memmlp.identity import RECIPE, flatten

HEARTBEAT = 5.0  # seconds between signs of life of a run's process
STALE = 60.0  # seconds without one after which a process on another machine counts as dead

ID = re.compile(r"[0-9a-f]{16}")


class Metrics(NamedTuple):
    """One line of the log: values at a step of a phase ("train", "val"), unix time in seconds."""

    step: int
    phase: str
    values: dict[str, float]
    time: float


class Diff(NamedTuple):
    """Dotted keys whose values differ between two runs, with both values ("-" where a run has none)."""

    config: dict[str, tuple[Any, Any]]
    results: dict[str, tuple[Any, Any]]


def now() -> str:
    """The time in UTC, to the second, ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="seconds")


class Run:
    """A folder outputs/runs/<id>/.

    Attributes:
        folder: the folder; `id` is its name.
        config_path, manifest_path, metrics_path, results_path, checkpoint, model, clips, onnx, latency,
            marker: its files; `config`, `manifest`, `metrics()` and `results` are what the first four hold.
    """

    FILES = (
        "config.yaml",
        "manifest.json",
        "metrics.jsonl",
        "checkpoint.safetensors",
        "model.safetensors",
        "clips.json",
        "results.json",
        "step.onnx",
        "step.int8.onnx",
        "latency.json",
        "poses.png",
        "FAILED",
    )

    def __init__(self, folder: Path | str):
        self.folder = Path(folder)
        self.id = self.folder.name
        self.config_path = self.folder / "config.yaml"
        self.manifest_path = self.folder / "manifest.json"
        self.metrics_path = self.folder / "metrics.jsonl"
        self.checkpoint = self.folder / "checkpoint.safetensors"
        self.model = self.folder / "model.safetensors"
        self.clips = self.folder / "clips.json"
        self.results_path = self.folder / "results.json"
        self.onnx = self.folder / "step.onnx"
        self.int8 = self.folder / "step.int8.onnx"
        self.latency = self.folder / "latency.json"
        self.marker = self.folder / "DONE"
        self._repaired = False

    @classmethod
    def of(cls, outputs: Path | str, run_id: str) -> Run:
        """The run of that id below an outputs folder, whether it exists or not."""
        return cls(Path(outputs) / "runs" / run_id)

    @property
    def deployed(self) -> Path:
        """The ONNX file to use: in int8 where the run has one that is as accurate (`export.precision`)."""
        record = read_json(self.latency) if self.int8.exists() else {}
        return self.int8 if record.get("int8", {}).get("default") else self.onnx

    def __repr__(self) -> str:
        return f"Run({str(self.folder)!r})"

    @contextlib.contextmanager
    def lock(self, say: Callable[[str], None] | None = None, wait: bool = True) -> Iterator[bool]:
        """Hold the run for this process, which may hold it already; yields whether it does.

        While another process has the run: wait and say so once (on stderr), or yield False without `wait`.
        A killed process loses its lock at once.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(self.folder / ".lock", is_singleton=True)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            if not wait:
                yield False
                return
            (say or _say)(f"run {self.id} is in the hands of {self._holder()}; waiting for it")
            lock.acquire()
        try:
            with self._heartbeat() if lock.lock_counter == 1 else contextlib.nullcontext():
                yield True
        finally:
            lock.release()

    @contextlib.contextmanager
    def _heartbeat(self) -> Iterator[None]:
        """Leave word of who holds the run, and a sign of life every few seconds."""
        holder, ended = self.folder / ".holder", threading.Event()
        write_json(holder, {"pid": os.getpid(), "host": host(), "since": now()})
        thread = threading.Thread(target=_beat, args=(holder, ended), daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
            holder.unlink(missing_ok=True)

    def _holder(self) -> str:
        holder = read_json(self.folder / ".holder")
        return f"process {holder['pid']} since {holder['since']}" if holder else "another process"

    @property
    def status(self) -> str:
        """One of: done, failed, running (a process is at it), lost (its process died), stopped, new."""
        if self.done:
            return "done"
        holder = read_json(self.folder / ".holder")
        if holder:
            return "running" if _lives(holder, self.folder / ".holder") else "lost"
        if self.failure:
            return "failed"
        return "stopped" if self.manifest_path.exists() else "new"

    @property
    def failure(self) -> str | None:
        """Why the run failed, in a line; None where it didn't."""
        return read_json(self.folder / "FAILED").get("reason")

    def fail(self, reason: str, details: str = "") -> None:
        """Leave word of why the run ended before it was done."""
        write_json(
            self.folder / "FAILED", {"reason": " ".join(reason.split()), "when": now(), "details": details}
        )

    def retry(self) -> None:
        """Forget the failure, and the attempts that led to it."""
        attempts = self.manifest.get("attempts", [])
        if self.failure and attempts:
            self.write_manifest({"forgiven": len(attempts)})
        (self.folder / "FAILED").unlink(missing_ok=True)

    def begin(self, kind: str, config: Mapping[str, Any], *, data: str, upstream: str | None) -> None:
        """Write config.yaml and the manifest of a run that starts or resumes."""
        self.folder.mkdir(parents=True, exist_ok=True)
        atomic_write(self.config_path, yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True))
        self.retry()
        started = self.manifest.get("started", now())
        attempt = {"started": now(), "pid": os.getpid(), "host": host(), "step": self.step}
        attempts = [*self.manifest.get("attempts", []), attempt]
        identity = {"id": self.id, "kind": kind, "data": data, "upstream": upstream, "recipe": RECIPE}
        times = {"started": started, "finished": None, "attempts": attempts}
        self.write_manifest(identity | times | environment())

    def write_manifest(self, fields: Mapping[str, Any]) -> None:
        """Add fields to the manifest, or replace them."""
        write_json(self.manifest_path, self.manifest | dict(fields))

    @property
    def manifest(self) -> dict[str, Any]:
        """What is known of the run; empty before it began."""
        return read_json(self.manifest_path)

    @property
    def config(self) -> dict[str, Any]:
        """The resolved config; empty before the run began. Raises InputError where it is damaged."""
        try:
            found = yaml.safe_load(self.config_path.read_text()) if self.config_path.exists() else {}
        except (yaml.YAMLError, UnicodeDecodeError):
            found = None
        if not isinstance(found, dict):
            raise InputError(f"{self.config_path}: cannot be read; remove the run's folder to do it again")
        return found

    @property
    def results(self) -> dict[str, Any]:
        """The results; empty before the evaluation."""
        return read_json(self.results_path)

    def log(self, step: int, values: Mapping[str, float], phase: str = "train") -> None:
        """Append one line to the metrics, in one write: a kill tears at most that line."""
        if not self._repaired:
            self.repair()
            self._repaired = True
        entry = {"step": step, "phase": phase, "time": round(time.time(), 3), "values": dict(values)}
        with open(self.metrics_path, "ab", buffering=0) as file:
            file.write(json.dumps(plain(entry), allow_nan=False).encode() + b"\n")

    @property
    def step(self) -> int:
        """The last step of training that is logged; 0 before the first."""
        return max((entry.step for entry in self.metrics()), default=0)

    def repair(self) -> None:
        """Cut a torn last line of the metrics off."""
        if self.metrics_path.exists():
            content = self.metrics_path.read_bytes()
            whole = content.rfind(b"\n") + 1
            if whole < len(content):
                os.truncate(self.metrics_path, whole)

    def metrics(self) -> list[Metrics]:
        """The log: a torn last line left out, of a step that a resumed run repeated the last."""
        if not self.metrics_path.exists():
            return []
        entries: dict[tuple[str, int], Metrics] = {}
        lines = self.metrics_path.read_bytes().split(b"\n")[:-1]
        for number, line in enumerate(lines, 1):
            try:
                entry = json.loads(line)
                values = {key: float(value) for key, value in entry["values"].items()}
                metrics = Metrics(entry["step"], entry["phase"], values, entry["time"])
            except (ValueError, KeyError, TypeError):
                raise InputError(f"{self.metrics_path}: line {number} is no line of a metrics log") from None
            entries[metrics.phase, metrics.step] = metrics
        return list(entries.values())

    def finish(self, artifacts: Sequence[str]) -> None:
        """Mark the run as done: the marker with the digests of its artifacts, last and atomically."""
        finished = now()
        self.write_manifest({"finished": finished})
        digests = {name: file_digest(self.folder / name) for name in artifacts}
        write_json(self.marker, {"id": self.id, "finished": finished, "artifacts": digests})

    @property
    def done(self) -> bool:
        """Whether the run was finished."""
        return "artifacts" in read_json(self.marker)

    def verify(self) -> list[str]:
        """The artifacts of a finished run that are missing or changed since."""
        artifacts = read_json(self.marker).get("artifacts", {})
        return [name for name, digest in artifacts.items() if not self._same(name, digest)]

    def _same(self, name: str, digest: str) -> bool:
        path = self.folder / name
        return path.is_file() and file_digest(path) == digest

    def reset(self) -> None:
        """Remove the run's own files, the marker first, and nothing else."""
        if not self.folder.exists():
            return
        self.marker.unlink(missing_ok=True)
        sync_folder(self.folder)
        for name in (*self.FILES, self.marker.name):
            for path in (self.folder / name, *self.folder.glob(f".{name}.*.tmp")):
                path.unlink(missing_ok=True)
        sync_folder(self.folder)


def _beat(holder: Path, ended: threading.Event) -> None:
    """Touch the holder's file until the end."""
    while not ended.wait(HEARTBEAT):
        with contextlib.suppress(OSError):
            os.utime(holder)


def _lives(holder: Mapping[str, Any], path: Path) -> bool:
    """Whether a holder's process lives: on this machine by its number, elsewhere by its heartbeat."""
    if holder.get("host") == host():
        return _runs(int(holder["pid"]))
    try:
        return time.time() - path.stat().st_mtime < STALE
    except OSError:
        return False


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _say(line: str) -> None:
    print(f"memmlp: {line}", file=sys.stderr, flush=True)


def list_runs(outputs: Path | str) -> list[Run]:
    """The runs below an outputs folder, the newest first."""
    folders = sorted((Path(outputs) / "runs").glob("*/"))
    runs = [Run(folder) for folder in folders if ID.fullmatch(folder.name)]
    return sorted(runs, key=lambda run: str(run.manifest.get("started", "")), reverse=True)


def find_run(outputs: Path | str, name: str) -> Run:
    """The run of an id, of the beginning of one, or of a folder."""
    if name and ("/" in name or not ID.fullmatch(name)) and (Path(name) / "manifest.json").is_file():
        return Run(Path(name).resolve())
    known = list_runs(outputs)
    matches = [run for run in known if name and run.id.startswith(name)]
    if len(matches) == 1:
        return matches[0]
    where = Path(outputs) / "runs"
    if not matches and name and (Path(name) / "manifest.json").is_file():
        return Run(Path(name).resolve())
    if not matches:
        raise InputError(f"run '{name}': no such folder, and no id in {where} ({len(known)}) begins so")
    ids = _enumerate(sorted(run.id for run in matches))
    raise InputError(f"run '{name}': {len(matches)} ids begin so: {ids}")


def _enumerate(names: Iterable[str], most: int = 8) -> str:
    """Names with commas, the first few of many."""
    every = list(names)
    return ", ".join(every[:most]) + (", ..." if len(every) > most else "")


def diff(a: Run, b: Run) -> Diff:
    """What two runs differ in."""
    return Diff(_differences(a.config, b.config), _differences(a.results, b.results))


def _differences(a: Mapping[str, Any], b: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    flat_a, flat_b = flatten(a), flatten(b)
    pairs = {key: (flat_a.get(key, "-"), flat_b.get(key, "-")) for key in flat_a | flat_b}
    return {key: pair for key, pair in pairs.items() if pair[0] != pair[1]}
