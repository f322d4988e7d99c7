"""Run folders: identity, lock, manifest, metrics log, completion. The folder is the truth; nothing else is.

JSON has no word for NaN and infinities: they are stored as the strings "nan", "inf" and "-inf".
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import math
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from filelock import FileLock, Timeout

import memmlp
from memmlp.errors import InputError

RECIPE = 1
"""Part of every identity: raise it when the code's results change for an unchanged config."""

IGNORED = (
    "data",  # its digest stands for it: frames, clips, split and rest pose
    "profile",  # sizes, read by the groups that use them
    "paths",
    "tracker",
    "device",
    "threads",
    "force",
    "save_predictions",
    "optim.checkpoint_every",
    "optim.log_every",
    "export",  # how long the clock runs
    "hydra",
)
"""Config keys that cannot change a run's result, and so are no part of its identity."""

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


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """A nested mapping with dotted keys; lists stay values."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping) and value:
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def plain(value: Any) -> Any:
    """The value as JSON can hold it."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def atomic_write(path: Path, content: bytes | str) -> None:
    """Write a file whole or not at all, even if the machine stops: temporary file, fsync, rename."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with open(temporary, "wb") as file:
        file.write(content.encode() if isinstance(content, str) else content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
    sync_folder(path.parent)


def write_json(path: Path, value: Any) -> None:
    """Write JSON atomically, keys in the order given."""
    atomic_write(path, json.dumps(plain(value), indent=2, allow_nan=False) + "\n")


def sync_folder(folder: Path) -> None:
    """Make renames and removals in a folder durable."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def file_digest(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def run_id(kind: str, config: Mapping[str, Any], *, data: str, upstream: str | None) -> str:
    """The identity of a run: 16 hex digits over all that can change its result.

    Args:
        kind: the stage ("vqvae", "memmlp").
        config: resolved config; IGNORED keys do not count, nor does 1 against 1.0.
        data: digest of the prepared data. upstream: id of the run whose artifact this one uses.
    """
    what = {"recipe": RECIPE, "kind": kind, "config": relevant(config), "data": data, "upstream": upstream}
    text = json.dumps(plain(what), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def relevant(config: Mapping[str, Any]) -> dict[str, Any]:
    """The dotted keys of a config that are part of the identity."""

    def counts(key: str) -> bool:
        return not any(key == ignored or key.startswith(f"{ignored}.") for ignored in IGNORED)

    return {key: _canonical(value) for key, value in flatten(config).items() if counts(key)}


def _canonical(value: Any) -> Any:
    """The same value for the same number, however it was typed."""
    if isinstance(value, list | tuple):
        return [_canonical(item) for item in value]
    if isinstance(value, float) and value.is_integer():
        return int(value)
    return value


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
        "latency.json",
        "poses.png",
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
        self.latency = self.folder / "latency.json"
        self.marker = self.folder / "DONE"
        self._repaired = False

    @classmethod
    def of(cls, outputs: Path | str, run_id: str) -> Run:
        """The run of that id below an outputs folder, whether it exists or not."""
        return cls(Path(outputs) / "runs" / run_id)

    def __repr__(self) -> str:
        return f"Run({str(self.folder)!r})"

    @contextlib.contextmanager
    def lock(self, say: Callable[[str], None] | None = None) -> Iterator[None]:
        """Hold the run for this process; while another one has it, wait and say so once (on stderr)."""
        self.folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(self.folder / ".lock")
        try:
            lock.acquire(timeout=0)
        except Timeout:
            (say or _say)(f"run {self.id} is in the hands of {self._holder()}; waiting for it")
            lock.acquire()
        try:
            write_json(self.folder / ".holder", {"pid": os.getpid(), "since": now()})
            yield
        finally:
            (self.folder / ".holder").unlink(missing_ok=True)
            lock.release()

    def _holder(self) -> str:
        holder = _read_json(self.folder / ".holder")
        return f"process {holder['pid']} since {holder['since']}" if holder else "another process"

    def begin(self, kind: str, config: Mapping[str, Any], *, data: str, upstream: str | None) -> None:
        """Write config.yaml and the manifest of a run that starts or resumes."""
        self.folder.mkdir(parents=True, exist_ok=True)
        atomic_write(self.config_path, yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True))
        started = self.manifest.get("started", now())
        identity = {"id": self.id, "kind": kind, "data": data, "upstream": upstream, "recipe": RECIPE}
        self.write_manifest(identity | {"started": started, "finished": None} | environment())

    def write_manifest(self, fields: Mapping[str, Any]) -> None:
        """Add fields to the manifest, or replace them."""
        write_json(self.manifest_path, self.manifest | dict(fields))

    @property
    def manifest(self) -> dict[str, Any]:
        """What is known of the run; empty before it began."""
        return _read_json(self.manifest_path)

    @property
    def config(self) -> dict[str, Any]:
        """The resolved config; empty before the run began."""
        return yaml.safe_load(self.config_path.read_text()) if self.config_path.exists() else {}

    @property
    def results(self) -> dict[str, Any]:
        """The results; empty before the evaluation."""
        return _read_json(self.results_path)

    def log(self, step: int, values: Mapping[str, float], phase: str = "train") -> None:
        """Append one line to the metrics, in one write: a kill tears at most that line."""
        if not self._repaired:
            self.repair()
            self._repaired = True
        entry = {"step": step, "phase": phase, "time": round(time.time(), 3), "values": dict(values)}
        with open(self.metrics_path, "ab", buffering=0) as file:
            file.write(json.dumps(plain(entry), allow_nan=False).encode() + b"\n")

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
        return "artifacts" in _read_json(self.marker)

    def verify(self) -> list[str]:
        """The artifacts of a finished run that are missing or changed since."""
        artifacts = _read_json(self.marker).get("artifacts", {})
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


def _say(line: str) -> None:
    print(f"memmlp: {line}", file=sys.stderr, flush=True)


def _read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file; empty if there is none or it does not parse."""
    try:
        value = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return value if isinstance(value, dict) else {}


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
    if not matches:
        raise InputError(f"run '{name}': no such folder, and no id in {where} ({len(known)}) begins so")
    raise InputError(f"run '{name}': {len(matches)} ids begin so: {_enumerate(run.id for run in matches)}")


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


def environment() -> dict[str, Any]:
    """What a run ran on and with; the machine's name only as a digest."""
    packages = ("torch", "numpy", "onnxruntime")
    return {
        "version": memmlp.__version__,
        "git": _git(),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in packages},
        "platform": platform.platform(),
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "host": hashlib.sha256(platform.node().encode()).hexdigest()[:12],
    }


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


@functools.cache
def _git() -> dict[str, Any] | None:
    """Commit of the checkout that the package lies in and whether it was changed; None when installed."""

    def git(*args: str) -> str:
        command = ["git", "-C", str(Path(memmlp.__file__).parent), *args]
        return subprocess.run(command, capture_output=True, text=True, timeout=20, check=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", "__init__.py")
        commit = git("rev-parse", "HEAD")
        return {"commit": commit, "dirty": bool(git("status", "--porcelain", "--", "."))}
    except (OSError, subprocess.SubprocessError):
        return None


def _cpu() -> str:
    """The processor's model name."""
    with contextlib.suppress(OSError):
        match = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
        if match:
            return match[1].strip()
    return platform.processor() or platform.machine()
