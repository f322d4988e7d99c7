"""The types of a run's records, and the only way to read them.

A run's folder may come from anybody. A record is read only if it is a regular file of a bounded size, has
only plain values, and its known fields have their types. Unknown fields are kept.
"""

import functools
import hashlib
import json
import os
import re
import stat
import types
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, TypedDict

from memmlp.common.components import SLOTS
from memmlp.common.errors import InputError
from memmlp.common.schema import check_type, parse_json, parse_yaml

MAX_JSON, MAX_YAML = 16 * 2**20, 2**18  # bytes
CACHED_FILES, CACHED_REASONS = 32, 20_000  # the records of three runs; the reasons of two thousand


def is_time(text: str) -> bool:
    """Return whether a text is a time in ISO 8601."""
    try:
        return bool(datetime.fromisoformat(text))
    except ValueError:
        return False


Time = Annotated[str, is_time]
Name = Annotated[str, re.compile(r"\w[\w.-]{0,200}").fullmatch]  # a file's name, without a folder
Number = Literal["nan", "inf", "-inf"] | float
Errors = dict[str, Number | None]
Word = str | int | None


def _record(*bases: Any, total: Any = False, **fields: Any) -> Any:
    """Make a TypedDict with these fields and those of its bases. New fields may be missing unless `total`."""
    content = {"__annotations__": fields, "__module__": __name__}
    return types.new_class("Record", bases or (TypedDict,), {"total": total}, lambda own: own.update(content))


_complete_record = functools.partial(_record, total=True)


# Code and machine
Commit = _complete_record(commit=str, dirty=bool)
EarlierCommit = _record(Commit, before=str)  # `before` the run was resumed
Plugin = _complete_record(version=str | None, digest=str)
Origin = _record(
    version=str, git=EarlierCommit | None, packages=dict[str, str | None] | None,
    component_versions=dict[str, int] | None, sources=dict[str, str] | None,
    plugins=dict[str, Plugin] | None,  # type: ignore[valid-type]
    **dict.fromkeys(("cpu", "device", "gpu", "gpu_index", "threads", "processes", "precision"), Word),
)  # fmt: skip

# manifest.json, DONE, FAILED and notes.json
Attempt = _record(started=Time, step=int, stage=str)
Imported = _complete_record(model=Name, file=str, sha256=str, source=str)  # imported weights
PrerequisiteRun = _record(Origin, id=Name, kind=str, weights=str | None)
Manifest = _record(
    Origin, id=str, kind=str, name=str, user=str | None, data=str, body=str,
    prerequisite=Name | None,
    prerequisite_runs=list[PrerequisiteRun] | None,  # type: ignore[valid-type]
    prerequisite_tflop=float | None, started=Time, finished=Time | None,
    attempts=list[Attempt],  # type: ignore[valid-type]
    seconds=dict[str, float] | None, forgiven=int, stages=list[Name],
    steps=int | None, best_step=int | None, tflop=float | None, source_bytes=dict[str, str],
    shipped=str, **dict.fromkeys(("partial", "divided", "resampled", "unusual"), str | None),
    imported=Imported | None,  # type: ignore[valid-type]
)  # fmt: skip
Marker = _record(id=str, finished=Time, artifacts=dict[Name, str])
Failure = _record(reason=str, when=Time, details=str)
Notes = _record(tags=list[str], note=str, name=str, archived=bool)

# config.yaml: the keys of its groups that are read without the components
Group = dict[str, Any] | None
Component = _record(name=str, frames=int | None, steps=int | None, batch=int | None, tflop=float | None)
Data = _record(name=str, split=Group, sources=dict[str, dict[str, Any]] | None, synth=Group)
Evaluating = _record(ik=str | bool | None, modes=list[str], metrics=list[str] | None)
Config = _record(
    plugins=list[str] | None, data=Data | None, vqvae=Component | None, evaluation=Evaluating,
    loggers=dict[str, Group] | None, optim=Component,  # type: ignore[valid-type]
    **dict.fromkeys(("paths", "profile"), Group), **dict.fromkeys(("normalizer", "export"), dict[str, Any]),
    **dict.fromkeys([slot for slot in SLOTS if slot != "optim"], Component | None),
)  # fmt: skip

# evaluations/ID.json and deployments/ID/latency.json
Settings = _record(
    mode=str, ik=str | None, ik_iterations=int | None, metrics=Group, graph=str, precision=str,
    opset=int,
)  # fmt: skip
Clip = _record(group=str | None, source=str | None, frames=int | None)  # other keys are branches
NamedClip = _complete_record(Clip, name=str)
ABOUT, Branches = {"name", *Clip.__annotations__}, dict[str, Errors]


def _has_branches(clip: Mapping[str, Any]) -> bool:
    check_type(dict(clip), NamedClip)
    check_type({key: value for key, value in clip.items() if key not in ABOUT}, Branches)
    return True


Results = _complete_record(
    mode=str, mean=dict[str, Errors],
    clips=list[Annotated[dict[str, Any], _has_branches]],
)  # fmt: skip
Evaluation = _record(
    Results, Origin, run=str, name=str, settings=Settings | None, made=str, made_by=Origin,
    digest=str, offline=bool,
)  # fmt: skip
COSTS = (
    "median_ms", "p95_ms", "alone_median_ms", "pose_median_ms", "ratio_to_yardstick", "core_share",
    "alone_core_share", "pose_core_share", "flops", "macs", "parameters", "onnx_bytes",
    "growth", "jitter_growth", "onnx_parity",
)  # fmt: skip
Costs = _record(**dict.fromkeys(COSTS, Number))
Deployment = _record(
    Costs, run=str, settings=Settings, made=str, made_by=Origin, artifacts=dict[Name, str],
    graph=str, int8=Costs, fp16=Costs,
)  # fmt: skip
LogEntry = _complete_record(step=int, phase=str, values=dict[str, Number], time=float)
Tree = dict[str, Any]  # results.json

# search.json: a search, and the command line that began it
SearchRecord = _record(
    _complete_record(
        name=str, base=list[str], space=list[_complete_record(key=str)],  # type: ignore[misc]
        objectives=Annotated[list[_complete_record(text=str)], len],  # type: ignore[misc]
        n_trials=int, tflop=float | None, storage=str | None,
    ),
    command_line=list[str],
)  # fmt: skip


def read(path: Path, kind: Any) -> dict[str, Any]:
    """Return the record in a file; empty if the file is missing or damaged (see `find_damage`)."""
    reason, stamp = _look_at(path, kind)
    return dict(_parse(path, kind, stamp)[0]) if stamp and not reason else {}


def load(path: Path, kind: Any) -> dict[str, Any]:
    """Return the record in a file; empty if the file is missing. Raises InputError if it is damaged."""
    if damage := find_damage(path, kind):
        raise InputError(f"{damage}; remove the file, or the run folder to repeat the run")
    return read(path, kind)


def find_damage(path: Path, kind: Any) -> str | None:
    """Return the file and the reason why it is not a record of this type; None if it is, or is missing."""
    reason, _ = _look_at(path, kind)
    return f"{path}: cannot be read ({reason})" if reason else None


Stamp = tuple[int, ...]  # changes with a file


def _look_at(path: Path, kind: Any) -> tuple[str | None, Stamp | None]:
    """Return the reason why a file is not a record, or None, and its stamp; None if it is missing."""
    try:
        found = os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        return None, None
    except OSError as error:
        return error.strerror, None
    limit = MAX_YAML if path.suffix == ".yaml" else MAX_JSON
    if not stat.S_ISREG(found.st_mode) or found.st_size > limit:
        return f"must be a file of at most {limit} bytes", None
    stamp = (found.st_mtime_ns, found.st_size, found.st_ino)
    return _find_reason(path, kind, stamp), stamp


@functools.lru_cache(CACHED_REASONS)
def _find_reason(path: Path, kind: Any, stamp: Stamp) -> str | None:
    return _parse(path, kind, stamp)[1]


@functools.lru_cache(CACHED_FILES)
def _parse(path: Path, kind: Any, stamp: Stamp) -> tuple[dict[str, Any], str | None]:
    """Return the record, and the reason why it cannot be read, or None."""
    try:
        content = path.read_bytes()
        value = parse_yaml(content.decode()) if path.suffix == ".yaml" else parse_json(content)
        check_type(value, kind)
        if kind is Evaluation and value.get("digest") != compute_digest(value):
            raise ValueError("changed since it was written: its digest is missing or wrong")
    except (OSError, ValueError) as error:
        return {}, getattr(error, "strerror", None) or " ".join(str(error).split())
    return value, None


def compute_digest(content: Mapping[str, Any]) -> str:
    """Return the digest of an evaluation's content, 16 hex digits."""
    content = {key: value for key, value in content.items() if key != "digest"}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]
