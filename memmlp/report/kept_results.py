"""A sweep's finished runs in compact form: per-clip errors, costs and origins, in one JSON file.

Every interval can be recomputed from the file, without training. Its bytes depend on its content alone: runs
are in the order of their ids, and numbers have six digits.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path, PurePath
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write, plain
from memmlp.runs.former_keys import with_present_keys
from memmlp.sweep.definition import Sweep
from memmlp.tables.effects import RunsBySeed
from memmlp.tables.measured_run import Errors, Measured, Origin

DIGITS = 6
FLAT_LIST = re.compile(r"\[\n([^\[\]{}]*?)\n *\]")  # of plain values; no string has a line's end in it
LATER_FACTS = (
    "partial",
    "processes",
    "offline",
    "deployed",
    "timed_on",
    "divided",
    "resampled",
    "unusual",
    "computed_imports",
    "upstream_recipes",
    "upstream_weights",
)  # the origins of older files have none of these
NO_LATER_FACTS = asdict(Origin(code="", changed=False, data="", hardware=""))
OLDER_NAMES = {"vqvae": "upstream"}  # what the origins of older files call otherwise


@dataclass(frozen=True)
class Kept:
    """The kept results of a sweep.

    Attributes:
        sweep: the sweep's name, as commands take it.
        overrides: the command line's overrides.
        runs: the finished runs by the arm's label and the seed.
        arms: the overrides with which each arm's runs were made.
        rounds: the rounds in which seeds were spent, in types for JSON; None if they were not spent in
            rounds.
        flags: what a reader has to know about how the seeds were chosen.
    """

    sweep: str
    overrides: tuple[str, ...]
    runs: Mapping[str, RunsBySeed]
    arms: Mapping[str, tuple[str, ...]]
    rounds: Mapping[str, Any] | None = None
    flags: tuple[str, ...] = ()

    @property
    def command(self) -> str:
        """The command that makes the runs again."""
        return " ".join(["memmlp sweep", self.sweep, *self.overrides])

    @property
    def untrained(self) -> int:
        """The number of networks whose costs were measured without a run."""
        return len({run.id for run in self.every if not run.means})

    @property
    def every(self) -> list[Measured]:
        """The runs, once for each evaluation and deployment that arms show, sorted by name."""
        return [run for _, run in sorted(self.named.items())]

    @property
    def count(self) -> int:
        """The number of runs."""
        return len({run.id for run in self.every})

    @cached_property
    def named(self) -> dict[str, Measured]:
        """The runs by their names in the file.

        A run's name is its id. If arms show several evaluations of one run, such as two kinds of inverse
        kinematics, a digest of the errors is appended; if they show several deployments, a digest of the
        costs follows.
        """
        of_id: dict[str, list[Measured]] = defaultdict(list)
        for run in (run for runs in self.runs.values() for run in runs.values()):
            of_id[run.id].append(run)
        named: dict[str, Measured] = {}
        for run_id, runs in of_id.items():
            if all(run is runs[0] for run in runs):
                named[run_id] = runs[0]
                continue
            found = {_key(run): run for run in runs}
            named |= {self._name(key, found): run for key, run in found.items()}
        return named

    def name(self, run: Measured) -> str:
        """Return a run's name in the file."""
        if run.id in self.named:
            return run.id
        run_id, errors, costs = _key(run)
        return next(
            name for name in (f"{run_id}/{errors}", f"{run_id}/{errors}-{costs}") if name in self.named
        )

    @staticmethod
    def _name(key: tuple[str, str, str], every: Iterable[tuple[str, str, str]]) -> str:
        """Return the name for an id and digests of errors and costs, unique among all that are kept."""
        run_id, errors, costs = key
        same = [one[1:] for one in every if one[0] == run_id]
        if len(same) == 1:
            return run_id
        alike = [one for one in same if one[0] == errors]
        return f"{run_id}/{errors}" if len(alike) == 1 else f"{run_id}/{errors}-{costs}"

    def merged(self, other: Kept) -> Kept:
        """Return the results with another's runs added; if both have an arm and seed, the other's is used.

        Raises:
            InputError: if the two are not from the same sweep with the same overrides, or if a fixed number
                of seeds would join seeds that were spent in rounds, so that verdicts would lose their level.
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

    def check_runs(self, wanted: Mapping[tuple[str, int], str]) -> None:
        """Check that the arms and seeds have the same runs that the sweep gives them now.

        An arm's overrides may be unchanged although their meaning has changed, by a default or a recipe.

        Args:
            wanted: the runs' ids by the arm's label and the seed; other runs are not checked.

        Raises:
            InputError: if an arm and seed has another run.
        """
        others = {
            label: sorted(seed for seed, run in runs.items() if wanted.get((label, seed), run.id) != run.id)
            for label, runs in self.runs.items()
        }
        for label, seeds in others.items():
            if seeds:
                several = ", ".join(map(str, seeds))
                raise InputError(
                    f"arm '{label}' has other runs than today's config, data and code make (seed {several})"
                )

    def check(self, arms: Mapping[str, tuple[str, ...]]) -> None:
        """Check that the arms have the overrides with which their runs were made.

        Raises:
            InputError: if an arm has other overrides, so that its runs belong to another arm with the same
                label.
        """
        for label, words in arms.items():
            if self.runs.get(label) and self.arms.get(label, words) != words:
                before, now = ", ".join(self.arms[label]) or "none", ", ".join(words) or "none"
                raise InputError(f"arm '{label}' was made with the overrides {before}, and has {now}")

    @property
    def sources(self) -> tuple[str, ...]:
        """The names of the sources of the test clips; empty if there is only one source."""
        every = (run for runs in self.runs.values() for run in runs.values())
        return tuple(sorted({source for run in every for source in run.clip_sources.values()}))

    def of(self, sweep: Sweep) -> dict[str, RunsBySeed]:
        """Return the runs of the arms and seeds that the sweep has now.

        Raises:
            InputError: as `check` does.
        """
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
    """Return the overrides that a sweep's file gives each arm, including those of the base."""
    bare = replace(sweep, command_line=())
    return {arm.label: without_paths(bare.all_overrides(arm)) for arm in sweep.runnable()}


def without_paths(overrides: Iterable[str]) -> tuple[str, ...]:
    """Return the overrides with absolute paths shortened to their last part, as they differ by machine."""

    def last(found: re.Match[str]) -> str:
        return f".../{PurePath(found[0]).name}"

    return tuple(re.sub(r"(?<==)/\S*|(?<=file://)/[^\s,\]]*", last, word) for word in overrides)


def save(path: Path, kept: Kept) -> None:
    """Write a file of results, completely or not at all. Raises InputError if it can't be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(path, dumps(kept))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None


def dumps(kept: Kept) -> str:
    """Return the text of a file of results."""
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
            label: {str(seed): kept.name(runs[seed]) for seed in sorted(runs)}
            for label, runs in sorted(kept.runs.items())
            if runs
        },
        "runs": {kept.name(run): _record(run) for run in kept.every},
    }
    content["digest"] = _digest(content)
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
    return FLAT_LIST.sub(_on_one_line, text) + "\n"


def _on_one_line(found: re.Match[str]) -> str:
    values = (line.strip() for line in found[1].split("\n"))
    return f"[{' '.join(values)}]"


def load_kept(path: Path) -> Kept:
    """Read a file of results. Raises InputError if it is none, or was edited after it was saved."""
    try:
        content = json.loads(path.read_bytes())
        if content.pop("digest", None) not in (None, _digest(content)):  # None: an older file
            raise ValueError("edited since it was saved")
        measured = {
            name: _measured(name, record, content["clips"][record["clips"]])
            for name, record in content["runs"].items()
        }
        cells = {
            label: {int(seed): measured[name] for seed, name in seeds.items()}
            for label, seeds in content["cells"].items()
        }
        typed, own = content["overrides"], content["arms"]
        words = with_present_keys(typed, beside=[word for arm in own.values() for word in arm])
        arms = {label: with_present_keys(arm, beside=typed) for label, arm in own.items()}
        flags = tuple(content.get("flags", ()))
        return Kept(content["sweep"], words, cells, arms, content["rounds"], flags)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: no file of results ({error}); make it with memmlp results save") from None


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def _errors(run: Measured) -> dict[str, Any]:
    """Return each metric of every test clip, by mode and branch, rounded to six digits."""
    names = list(run.clips)
    return {
        mode: {
            branch: {
                metric: [_short(float(value)) for value in run.by_clip(names, mode, branch, metric)]
                for metric in metrics
            }
            for branch, metrics in branches.items()
        }
        for mode, branches in run.means.items()
    }


def _key(run: Measured) -> tuple[str, str, str]:
    """Return a run's id, and digests of its kept errors and costs."""
    parts = (json.dumps(part, sort_keys=True) for part in (_errors(run), _shortened_costs(run)))
    errors, costs = (hashlib.sha256(part.encode()).hexdigest()[:8] for part in parts)
    return run.id, errors, costs


def _shortened_costs(run: Measured) -> dict[str, Any]:
    return {name: _short(cost) for name, cost in run.costs.items()}


def _record(run: Measured) -> dict[str, Any]:
    """Return the record of a run in the file."""
    costs = _shortened_costs(run)
    origin = plain(asdict(run.origin))
    for name in LATER_FACTS:
        if origin[name] == NO_LATER_FACTS[name]:
            del origin[name]
    training = {"training": {name: _short(number) for name, number in run.training.items()}}
    record = {"origin": origin, "clips": _clips_key(run), "costs": costs}
    return record | (training if run.training else {}) | {"errors": _errors(run)}


def _clips(run: Measured) -> list[list[str]]:
    """Return the names of the test clips, each with its group, and with its source if there are several."""
    sources = run.clip_sources
    return [[name, run.group(name), *([sources[name]] if sources else [])] for name in run.clips]


def _clips_key(run: Measured) -> str:
    return hashlib.sha256(json.dumps(_clips(run)).encode()).hexdigest()[:8]


def _measured(name: str, record: Mapping[str, Any], clips: Sequence[Sequence[str]]) -> Measured:
    """Return a run from its record in the file."""
    names, errors = [clip for clip, *_ in clips], record["errors"]
    if any(len(values) != len(names) for values in _every(errors)):
        raise ValueError(f"run {name} has not as many errors as clips")
    origin = {OLDER_NAMES.get(key, key): value for key, value in record["origin"].items()}
    measured = Measured(
        id=name.partition("/")[0],
        means=errors,
        clips=_of_clips(errors, names),
        groups={clip: group for clip, group, *_ in clips},
        clip_sources={clip: source[0] for clip, _, *source in clips if source},
        costs=record["costs"],
        origin=Origin(**origin),
        training=record.get("training", {}),
    )
    return measured.over(names)


def _of_clips(errors: Mapping[str, Any], names: Sequence[str]) -> Mapping[str, Errors]:
    """Return the errors of each clip, from each metric's list of values."""
    clips: dict[str, dict[str, dict[str, Any]]] = {name: {mode: {} for mode in errors} for name in names}
    for mode, branches in errors.items():
        for branch, metrics in branches.items():
            rows = zip(*metrics.values(), strict=True) if metrics else [()] * len(names)
            for name, row in zip(names, rows, strict=True):
                clips[name][mode][branch] = dict(zip(metrics, row, strict=True))
    return clips


def _every(errors: Mapping[str, Any]) -> list[Sequence[Any]]:
    """Return each metric's list of values."""
    return [
        values for branches in errors.values() for metrics in branches.values() for values in metrics.values()
    ]


def _short(value: float) -> float | str | None:
    """Return a number rounded to six digits; None for NaN, and infinity as a word."""
    short = float(f"{value:.{DIGITS}g}")
    if math.isfinite(short):
        return short
    return None if math.isnan(short) else str(short)
