"""A sweep's finished runs in compact form: per-clip errors, costs and origins, in one JSON file.

Whoever has the file can recompute every interval without training. Its bytes depend on what it holds alone:
runs stand in the order of their ids, numbers have six digits.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write, plain
from memmlp.sweep.spec import Sweep
from memmlp.tables.effects import Runs
from memmlp.tables.measured import Errors, Measured, Origin

DIGITS = 6
SCALES = re.compile(r"\[\s+([^\[\]{}]*?)\s+\]")  # a list of plain values


@dataclass(frozen=True)
class Kept:
    """What is kept of a sweep.

    Attributes:
        sweep: its name, as the commands take it. overrides: those of the command line.
        runs: the finished runs by the arm's label and the seed.
        arms: the overrides of each arm that the runs were made with.
        rounds: of seeds that were spent in rounds, as JSON holds them; None where they were not.
        flags: what a reader has to know of how the seeds came about.
    """

    sweep: str
    overrides: tuple[str, ...]
    runs: Mapping[str, Runs]
    arms: Mapping[str, tuple[str, ...]]
    rounds: Mapping[str, Any] | None = None
    flags: tuple[str, ...] = ()

    @property
    def command(self) -> str:
        """What makes the runs again."""
        return " ".join(["memmlp sweep", self.sweep, *self.overrides])

    @property
    def every(self) -> list[Measured]:
        """The runs, each once, by id."""
        found = {run.id: run for runs in self.runs.values() for run in runs.values()}
        return [found[name] for name in sorted(found)]

    def merged(self, other: Kept) -> Kept:
        """With another's runs added; where both have a cell, the other's stands.

        Raises InputError where they are not of one sweep and the same overrides, or would join seeds of a
        fixed number to such as were spent in rounds: no verdict would keep its level.
        """
        if (self.sweep, self.overrides) != (other.sweep, other.overrides):
            raise InputError(f"holds the results of '{self.command}', not of '{other.command}'")
        if self.rounds and not other.rounds:
            raise InputError("holds seeds that were spent in rounds, and these were not")
        self.check(other.arms)
        labels = dict.fromkeys([*self.runs, *other.runs])
        runs = {label: {**self.runs.get(label, {}), **other.runs.get(label, {})} for label in labels}
        arms, flags = {**self.arms, **other.arms}, tuple(dict.fromkeys([*self.flags, *other.flags]))
        return replace(self, runs=runs, arms=arms, rounds=other.rounds, flags=flags)

    def check(self, arms: Mapping[str, tuple[str, ...]]) -> None:
        """Raise InputError where an arm has other overrides: the runs are of another arm of that name."""
        for label, words in arms.items():
            if label in self.arms and self.arms[label] != words:
                before, now = ", ".join(self.arms[label]) or "none", ", ".join(words) or "none"
                raise InputError(f"arm '{label}' was made with the overrides {before}, and has {now}")

    def of(self, sweep: Sweep) -> dict[str, Runs]:
        """The runs of the arms and seeds that the sweep has today. Raises InputError as `check` does."""
        self.check(overrides_of(sweep))
        return {
            arm.label: {
                seed: run
                for seed, run in sorted(self.runs.get(arm.label, {}).items())
                if seed in sweep.seeds_of(arm)
            }
            for arm in sweep.runnable()
        }


def overrides_of(sweep: Sweep) -> dict[str, tuple[str, ...]]:
    """The overrides that the file of a sweep gives each arm, its base's among them."""
    bare = replace(sweep, extra=())
    return {arm.label: without_paths(bare.overrides(arm)) for arm in sweep.runnable()}


def without_paths(overrides: Iterable[str]) -> tuple[str, ...]:
    """Overrides, their absolute paths shortened to the last part: they are each machine's own."""
    return tuple(re.sub(r"(?<==)/\S*", lambda found: f".../{PurePath(found[0]).name}", w) for w in overrides)


def save(path: Path, kept: Kept) -> None:
    """Write a file of results, atomically. Raises InputError where it cannot be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(path, dumps(kept))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None


def dumps(kept: Kept) -> str:
    """The file's text."""
    clips = {_clips_key(run): _clips(run) for run in kept.every}
    content = {
        "sweep": kept.sweep,
        "overrides": list(kept.overrides),
        "command": kept.command,
        "arms": {label: list(words) for label, words in sorted(kept.arms.items())},
        "rounds": kept.rounds,
        **({"flags": list(kept.flags)} if kept.flags else {}),
        "clips": dict(sorted(clips.items())),
        "cells": {
            label: {str(seed): runs[seed].id for seed in sorted(runs)}
            for label, runs in sorted(kept.runs.items())
            if runs
        },
        "runs": {run.id: _record(run) for run in kept.every},
    }
    content["digest"] = _digest(content)
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
    return SCALES.sub(lambda found: f"[{' '.join(found[1].split())}]", text) + "\n"


def load_kept(path: Path) -> Kept:
    """Read a file of results. Raises InputError where it is none, or was edited since."""
    try:
        content = json.loads(path.read_bytes())
        if content.pop("digest", None) not in (None, _digest(content)):  # None: before there was one
            raise ValueError("edited since it was saved")
        measured = {
            name: _measured(name, record, content["clips"][record["clips"]])
            for name, record in content["runs"].items()
        }
        cells = {
            label: {int(seed): measured[name] for seed, name in seeds.items()}
            for label, seeds in content["cells"].items()
        }
        arms = {label: tuple(words) for label, words in content["arms"].items()}
        words, flags = tuple(content["overrides"]), tuple(content.get("flags", ()))
        return Kept(content["sweep"], words, cells, arms, content["rounds"], flags)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: no file of results ({error}); make it with memmlp results save") from None


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def _record(run: Measured) -> dict[str, Any]:
    """What is kept of a run."""
    names = list(run.clips)
    errors = {
        mode: {
            branch: {
                metric: [_short(float(value)) for value in run.by_clip(names, mode, branch, metric)]
                for metric in metrics
            }
            for branch, metrics in branches.items()
        }
        for mode, branches in run.means.items()
    }
    costs = {name: _short(cost) for name, cost in run.costs.items()}
    return {"origin": plain(asdict(run.origin)), "clips": _clips_key(run), "costs": costs, "errors": errors}


def _clips(run: Measured) -> list[list[str]]:
    """The test clips, each with its group."""
    return [[name, run.group(name)] for name in run.clips]


def _clips_key(run: Measured) -> str:
    return hashlib.sha256(json.dumps(_clips(run)).encode()).hexdigest()[:8]


def _measured(name: str, record: Mapping[str, Any], clips: Sequence[Sequence[str]]) -> Measured:
    names, errors = [clip for clip, _ in clips], record["errors"]
    if any(len(values) != len(names) for values in _every(errors)):
        raise ValueError(f"run {name} has not as many errors as clips")
    return Measured(
        id=name,
        means=_each(errors, _mean),
        clips={clip: _each(errors, lambda values, i=i: values[i]) for i, clip in enumerate(names)},
        groups={clip: group for clip, group in clips},
        costs=record["costs"],
        origin=Origin(**record["origin"]),
    )


def _each(errors: Mapping[str, Any], what: Any) -> Errors:
    """The errors with each metric's list of values made one."""
    return {
        mode: {
            branch: {metric: what(values) for metric, values in metrics.items()}
            for branch, metrics in branches.items()
        }
        for mode, branches in errors.items()
    }


def _every(errors: Mapping[str, Any]) -> list[Sequence[Any]]:
    """Each metric's list of values."""
    return [
        values for branches in errors.values() for metrics in branches.values() for values in metrics.values()
    ]


def _mean(values: Sequence[float | str | None]) -> float:
    """Of the clips that have a number, as the evaluation does it; NaN where none has."""
    known = [float(value) for value in values if value is not None]
    return float(np.mean(known)) if known else math.nan


def _short(value: float) -> float | str | None:
    """A number of six digits; None for what is none, infinity as a word."""
    return None if math.isnan(value) else plain(float(f"{value:.{DIGITS}g}"))
