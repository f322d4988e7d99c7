"""Run folders: lock, manifest, metrics log, completion. The folder is the truth; nothing else is.

A run is done when it is trained. What was evaluated and shipped of it lies below its folder, a file or folder
for each evaluation and deployment, named by its identity, there whole or not at all.
"""

from __future__ import annotations

import contextlib
import hashlib
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

from memmlp.environment import changes, environment, host, sources
from memmlp.errors import InputError
from memmlp.files import atomic_write, file_digest, plain, read_json, sync_folder, write_json
from memmlp.identity import deployment_name, evaluation_name, flatten, used_as_configured

HEARTBEAT = 5.0  # seconds between signs of life of a run's process
STALE = 60.0  # seconds without one after which a process on another machine counts as dead

MACHINE = ("device", "gpu", "threads", "precision", "cpu")  # what can change a result's last digits

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


class Deployed:
    """What a run was shipped as: a folder runs/<id>/deployments/<identity>/.

    Attributes:
        onnx, int8, latency: its files; the last one is written last, and says what was measured.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.onnx = folder / "step.onnx"
        self.int8 = folder / "step.int8.onnx"
        self.latency = folder / "latency.json"

    @property
    def done(self) -> bool:
        """Whether all of it is there, and of the run below which it lies."""
        record = read_json(self.latency)
        whole = all((self.folder / name).is_file() for name in record.get("artifacts", {}))
        return bool(record) and whole and _lies_right(record.get("run"), self.folder.parent.parent)

    @property
    def current(self) -> bool:
        """Whether it was made by today's recipes."""
        return self.folder.name == deployment_name(self.settings)

    def finish(self, record: Mapping[str, Any]) -> None:
        """Write what was measured, with the digests of the files: the sign that all of it is there."""
        artifacts = {path.name: file_digest(path) for path in (self.onnx, self.int8) if path.exists()}
        made = {"made": now(), "made_by": environment(), "artifacts": artifacts}
        write_json(self.latency, {**record, **made})

    @property
    def made(self) -> str:
        """When."""
        return str(read_json(self.latency).get("made", ""))

    @property
    def settings(self) -> dict[str, Any]:
        """What was asked for."""
        return dict(read_json(self.latency).get("settings", {}))

    @property
    def prefers_int8(self) -> bool:
        """Whether its int8 file is as accurate as the other one."""
        return self.int8.exists() and bool(read_json(self.latency).get("int8", {}).get("default"))


class Run:
    """A folder outputs/runs/<id>/.

    Attributes:
        folder: the folder; `id` is its name.
        config_path, manifest_path, metrics_path, results_path, checkpoint, model, marker: its files;
            `config`, `manifest` and `metrics()` are what the first three hold.
        evaluations, deployments: the folders of what was made of the trained network.
    """

    FILES = (
        "deployments/*/latency.json",
        "deployments/*/step.onnx",
        "deployments/*/step.int8.onnx",
        "evaluations/*.json",
        "checkpoint.safetensors",
        "model.safetensors",
        "results.json",
        "metrics.jsonl",
        "poses.png",
        "FAILED",
        "code.patch",
        "config.yaml",
        "manifest.json",
    )
    """A run's own files, in the order in which a reset removes them: results before what they are of."""
    STAGES = FILES[:4]

    def __init__(self, folder: Path | str):
        self.folder = Path(folder)
        self.id = self.folder.name
        self.config_path = self.folder / "config.yaml"
        self.manifest_path = self.folder / "manifest.json"
        self.metrics_path = self.folder / "metrics.jsonl"
        self.checkpoint = self.folder / "checkpoint.safetensors"
        self.model = self.folder / "model.safetensors"
        self.results_path = self.folder / "results.json"
        self.evaluations = self.folder / "evaluations"
        self.deployments = self.folder / "deployments"
        self.marker = self.folder / "DONE"
        self._repaired = False

    @classmethod
    def of(cls, outputs: Path | str, run_id: str) -> Run:
        """The run of that id below an outputs folder, whether it exists or not."""
        return cls(Path(outputs) / "runs" / run_id)

    def evaluation(self, identity: str) -> Path:
        """The file of an evaluation, whether it was made or not."""
        return self.evaluations / f"{identity}.json"

    def deployment(self, identity: str) -> Deployed:
        """The folder of a deployment, whether it was made or not."""
        return Deployed(self.deployments / identity)

    def has(self, stage: str) -> bool:
        """Whether the evaluation or deployment of that identity was made."""
        return self.evaluation(stage).is_file() or self.deployment(stage).done

    @property
    def shipped(self) -> Deployed:
        """The deployment to use, of those with the run's own settings: of today's recipes where there is one,
        one whose int8 is as accurate, or the last one.
        """
        made = [Deployed(path.parent) for path in self.deployments.glob("*/latency.json")]
        own = [one for one in made if one.done and used_as_configured(one.settings, self.config)]
        best = max(own, key=lambda one: (one.current, one.prefers_int8, one.made), default=None)
        return best or Deployed(self.deployments / "none")

    @property
    def deployed(self) -> Path:
        """The ONNX file to use: in int8 where the run has one that is as accurate (`export.precision`)."""
        return self.shipped.int8 if self.shipped.prefers_int8 else self.shipped.onnx

    @property
    def onnx(self) -> Path:
        """The float32 ONNX file of the deployment to use."""
        return self.shipped.onnx

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
        return self.state(self.done)

    def state(self, complete: bool) -> str:
        """The status of work on the run that is complete or not."""
        if complete:
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

    def begin(
        self, kind: str, config: Mapping[str, Any], *, data: str, upstream: str | None, **facts: Any
    ) -> None:
        """Write config.yaml and the manifest of a run that starts or resumes.

        The patch of code that was changed since its commit is kept beside them.

        Args:
            facts: further entries of the manifest: recipes, device, threads, ...
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        atomic_write(self.config_path, yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True))
        if patch := changes():
            atomic_write(self.folder / "code.patch", patch)
        identity = {"id": self.id, "kind": kind, "data": data, "upstream": upstream}
        before = self.manifest if self.checkpoint.exists() else {}
        made = joined(before, {**facts, **environment(), "sources": sources()})
        self.attempt("training")
        times = {"started": self.manifest.get("started", now()), "finished": None}
        self.write_manifest(identity | times | made)

    def attempt(self, stage: str) -> None:
        """Note that a process is at a stage of the run."""
        self.retry()
        begun = {"started": now(), "pid": os.getpid(), "host": host(), "step": self.step, "stage": stage}
        self.write_manifest({"attempts": [*self.manifest.get("attempts", []), begun]})

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
        """What was measured with the run's own settings: mode -> branch -> metric, "latency"; of a VQ-VAE its
        own results.

        Where a branch was evaluated by inverse kinematics of several lengths, the last one counts; tables ask
        for theirs by its identity.
        """
        found = read_json(self.results_path)
        for report in map(read_json, self.own_evaluations):
            found[report["mode"]] = {**found.get(report["mode"], {}), **report["mean"]}
        latency = read_json(self.shipped.latency)
        return found | ({"latency": latency} if latency else {})

    @property
    def own_evaluations(self) -> list[Path]:
        """The evaluations using the network as the run's config does: older recipes first, then by time."""
        config, paths = self.config, sorted(self.evaluations.glob("*.json"))
        every = {path: read_json(path) for path in paths}
        own = [path for path, made in every.items() if used_as_configured(made.get("settings", {}), config)]
        return sorted(own, key=lambda path: (_current(path, every[path]), str(every[path].get("made"))))

    @property
    def changed_sources(self) -> list[str]:
        """The package's files whose code is not what the run was made by; none if that is unknown."""
        before = self.manifest.get("sources", {})
        return sorted(name for name, digest in sources().items() if before and before.get(name) != digest)

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
        """Whether the run was finished, and is no other's folder under its id."""
        marker = read_json(self.marker)
        return "artifacts" in marker and _lies_right(marker.get("id"), self.folder)

    def weights(self) -> Path:
        """The trained weights. Raises InputError where they are others than were trained."""
        digest = read_json(self.marker).get("artifacts", {}).get(self.model.name)
        if digest and not self._same(self.model.name, digest):
            raise InputError(
                f"{self.model}: not the weights that were trained; do the run again with force=true"
            )
        return self.model

    def verify(self) -> list[str]:
        """The artifacts of a finished run that are missing or changed since."""
        artifacts = dict(read_json(self.marker).get("artifacts", {}))
        for latency in sorted(self.deployments.glob("*/latency.json")):
            where = latency.parent.relative_to(self.folder)
            made = read_json(latency).get("artifacts", {})
            artifacts |= {str(where / name): digest for name, digest in made.items()}
        changed = [name for name, digest in artifacts.items() if not self._same(name, digest)]
        reports = sorted(self.evaluations.glob("*.json"))
        return changed + [str(path.relative_to(self.folder)) for path in reports if not intact(path)]

    def _same(self, name: str, digest: str) -> bool:
        path = self.folder / name
        return path.is_file() and file_digest(path) == digest

    def reset(self) -> None:
        """Remove the run's own files, the marker first, and nothing else."""
        if not self.folder.exists():
            return
        self.marker.unlink(missing_ok=True)
        sync_folder(self.folder)
        self._remove((*self.FILES, self.marker.name))

    def clear_stages(self) -> None:
        """Remove what was made of earlier weights."""
        self._remove(self.STAGES)

    def _remove(self, names: Iterable[str]) -> None:
        for name in names:
            temporary = str(Path(name).with_name(f".{Path(name).name}.*.tmp"))
            for path in (*self.folder.glob(name), *self.folder.glob(temporary)):
                path.unlink(missing_ok=True)
        for folder in (*self.deployments.glob("*/"), self.evaluations, self.deployments):
            with contextlib.suppress(OSError):  # there is none, or there are files of the user's
                folder.rmdir()
        sync_folder(self.folder)


def joined(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    """What a training was made on and by that was resumed: where the two differ, both.

    A file whose code changed in between has no digest that any code has.
    """
    found = dict(after)
    for key in MACHINE:
        words = [before[key]] if key in before and before[key] != after.get(key) else []
        found[key] = ", ".join(map(str, [*words, after[key]])) if words else after.get(key)
    old, new = before.get("git"), after.get("git")
    if old and new:
        other = old.get("before") or (old["commit"] if old["commit"] != new["commit"] else None)
        found["git"] = {**new, "dirty": old["dirty"] or new["dirty"]} | ({"before": other} if other else {})
    known = before.get("sources", after["sources"])
    found["sources"] = {
        name: digest if known.get(name) == digest else "mixed" for name, digest in after["sources"].items()
    }
    return found


def _lies_right(run_id: str | None, folder: Path) -> bool:
    """Whether what was made of a run of that id lies in its folder. A folder of another name is a copy."""
    return run_id in (None, folder.name) or not ID.fullmatch(folder.name)


def _current(path: Path, report: Mapping[str, Any]) -> bool:
    """Whether an evaluation was made by today's recipes."""
    settings = report.get("settings") or {}
    return {"mode", "ik"} <= settings.keys() and path.stem == evaluation_name(settings)


def write_report(path: Path, report: Mapping[str, Any]) -> None:
    """Write the file of an evaluation: what was measured, when, by what, and its digest."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = plain({**report, "made": now(), "made_by": environment()})
    write_json(path, content | {"digest": _content_digest(content)})


def intact(path: Path) -> bool:
    """Whether the file of an evaluation is as it was written, and where."""
    content = read_json(path)
    same = content.pop("digest", None) == _content_digest(content)
    named = content.get("name", path.stem) == path.stem
    return same and named and _lies_right(content.get("run"), path.parent.parent)


def _content_digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


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
