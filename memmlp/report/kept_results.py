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
from memmlp.report.tables.effects import RunsBySeed
from memmlp.report.tables.measured_run import Errors, Measured, Origin
from memmlp.sweep.definition import Sweep

DIGITS = 6
FLAT_LIST = re.compile(r"\[\n([^\[\]{}]*?)\n *\]")  # of plain values; no string contains a line break
DEFAULT_ORIGIN = plain(asdict(Origin(code="", changed=False, data="", hardware="")))
REQUIRED = ("code", "changed", "data", "hardware")  # facts of an origin that a file always has


@dataclass(frozen=True)
class Kept:
    """The kept results of a sweep.

    Attributes:
        sweep: the sweep's name, as commands take it.
        overrides: the command line's overrides.
        runs: the finished runs by the variant's label and the seed.
        variants: the overrides with which each variant's runs were made.
        rounds: the rounds in which seeds were spent, in types for JSON; None if they were not spent in
            rounds.
        flags: warnings about how the seeds were chosen.
    """

    sweep: str
    overrides: tuple[str, ...]
    runs: Mapping[str, RunsBySeed]
    variants: Mapping[str, tuple[str, ...]]
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
        """The runs, once for each evaluation and deployment that variants show, sorted by name."""
        return [run for _, run in sorted(self.named.items())]

    @property
    def count(self) -> int:
        """The number of runs."""
        return len({run.id for run in self.every})

    @cached_property
    def named(self) -> dict[str, Measured]:
        """The runs by their names in the file."""
        objects = {id(run): run for by_seed in self.runs.values() for run in by_seed.values()}
        return {self.names[key]: run for key, run in objects.items()}

    @cached_property
    def names(self) -> dict[int, str]:
        """The runs' names in the file, by their objects' `id()`.

        A name is the run's id. If variants show several evaluations or deployments of one run, a digest of
        its record is appended.
        """
        by_id: dict[str, list[Measured]] = defaultdict(list)
        for run in {id(run): run for by_seed in self.runs.values() for run in by_seed.values()}.values():
            by_id[run.id].append(run)
        names: dict[int, str] = {}
        for run_id, runs in by_id.items():
            digests = [_digest(_record(run))[:8] for run in runs] if len(runs) > 1 else [""]
            several = len(set(digests)) > 1
            names |= {
                id(run): f"{run_id}/{digest}" if several else run_id
                for run, digest in zip(runs, digests, strict=True)
            }
        return names

    def merge(self, other: Kept) -> Kept:
        """Return the results with another's runs added; if both have a variant and seed, the other's is used.

        Raises:
            InputError: if the two are not from the same sweep with the same overrides, or if a fixed number
                of seeds would join seeds that were spent in rounds, so that verdicts would lose their level.
        """
        if (self.sweep, self.overrides) != (other.sweep, other.overrides):
            raise InputError(f"holds the results of '{self.command}', not of '{other.command}'")
        if self.rounds and not other.rounds:
            raise InputError("holds seeds that were spent in rounds, and these were not")
        self.check(other.variants)
        labels = dict.fromkeys([*self.runs, *other.runs])
        runs = {label: {**self.runs.get(label, {}), **other.runs.get(label, {})} for label in labels}
        flags = tuple(dict.fromkeys([*self.flags, *other.flags]))
        variants = {**self.variants, **other.variants}
        return replace(self, runs=runs, variants=variants, rounds=other.rounds, flags=flags)

    def check_runs(self, planned: Mapping[tuple[str, int], str]) -> None:
        """Check that the variants and seeds have the same runs that the sweep gives them now.

        A variant's overrides may be unchanged although their meaning has changed, by a default or a component
        version.

        Args:
            planned: the runs' ids by the variant's label and the seed; other runs are not checked.

        Raises:
            InputError: if a variant and seed has another run.
        """
        for label, runs in self.runs.items():
            seeds = sorted(seed for seed, run in runs.items() if planned.get((label, seed), run.id) != run.id)
            if seeds:
                raise InputError(
                    f"variant '{label}' has other runs than the current config, data and code make (seed "
                    f"{', '.join(map(str, seeds))})"
                )

    def check(self, variants: Mapping[str, tuple[str, ...]]) -> None:
        """Check that the variants have the overrides with which their runs were made.

        Raises:
            InputError: if a variant has other overrides, so that its runs belong to another variant with the
                same label.
        """
        for label, words in variants.items():
            if self.runs.get(label) and self.variants.get(label, words) != words:
                before, now = ", ".join(self.variants[label]) or "none", ", ".join(words) or "none"
                raise InputError(f"variant '{label}' was made with the overrides {before}, and now has {now}")

    @property
    def sources(self) -> tuple[str, ...]:
        """The names of the sources of the test clips; empty if there is only one source."""
        return tuple(sorted({source for run in self.every for source in run.clip_sources.values()}))

    def runs_of(self, sweep: Sweep) -> dict[str, RunsBySeed]:
        """Return the runs of the variants and seeds that the sweep has now.

        Raises:
            InputError: as `check` does.
        """
        self.check(list_overrides(sweep))
        return {
            variant.label: {
                seed: run
                for seed, run in sorted(self.runs.get(variant.label, {}).items())
                if seed in sweep.seeds_of(variant)
            }
            for variant in sweep.runnable()
        }


def list_overrides(sweep: Sweep) -> dict[str, tuple[str, ...]]:
    """Return the overrides that a sweep's file gives each variant, including those of the base."""
    bare = replace(sweep, command_line=())
    return {variant.label: shorten_paths(bare.all_overrides(variant)) for variant in sweep.runnable()}


def shorten_paths(overrides: Iterable[str]) -> tuple[str, ...]:
    """Return the overrides with absolute paths shortened to their last part, as they differ by machine."""

    def last(found: re.Match[str]) -> str:
        return f".../{PurePath(found[0]).name}"

    return tuple(re.sub(r"(?<==)/\S*|(?<=file://)/[^\s,\]]*", last, text) for text in overrides)


def save(path: Path, kept: Kept) -> None:
    """Write a file of results, completely or not at all. Raises InputError if it can't be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(path, dumps(kept))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None


def dumps(kept: Kept) -> str:
    """Return the text of a file of results."""
    content = {
        "sweep": kept.sweep,
        "overrides": list(kept.overrides),
        "command": kept.command,
        "variants": {label: list(words) for label, words in sorted(kept.variants.items())},
        "rounds": kept.rounds,
        "flags": list(kept.flags),
        "clips": dict(sorted({_digest(_clips(run))[:8]: _clips(run) for run in kept.every}.items())),
        "cells": {
            label: {str(seed): kept.names[id(runs[seed])] for seed in sorted(runs)}
            for label, runs in sorted(kept.runs.items())
            if runs
        },
        "runs": {name: _record(run) for name, run in sorted(kept.named.items())},
    }
    content["digest"] = _digest(content)
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
    return FLAT_LIST.sub(lambda found: f"[{' '.join(map(str.strip, found[1].splitlines()))}]", text) + "\n"


def load_kept(path: Path) -> Kept:
    """Read a file of results. Raises InputError if it is damaged, or was edited after it was saved."""
    try:
        content = json.loads(path.read_bytes())
        if content.pop("digest") != _digest(content):
            raise ValueError("edited since it was saved")
        runs = {
            name: _measured(name, record, content["clips"][record["clips"]])
            for name, record in content["runs"].items()
        }
        cells = {
            label: {int(seed): runs[name] for seed, name in seeds.items()}
            for label, seeds in content["cells"].items()
        }
        variants = {label: tuple(words) for label, words in content["variants"].items()}
        overrides, flags = tuple(content["overrides"]), tuple(content["flags"])
        return Kept(content["sweep"], overrides, cells, variants, content["rounds"], flags)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: damaged ({error}); make it again with memmlp results save") from None


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def _record(run: Measured) -> dict[str, Any]:
    """Return the record of a run in the file: origin, costs, and each metric of every test clip."""
    names = list(run.clips)
    origin = {
        key: value
        for key, value in plain(asdict(run.origin)).items()
        if key in REQUIRED or value != DEFAULT_ORIGIN[key]
    }
    errors = {
        mode: {
            branch: {metric: _shorten(run.by_clip(names, mode, branch, metric)) for metric in metrics}
            for branch, metrics in branches.items()
        }
        for mode, branches in run.means.items()
    }
    numbers = {
        kind: dict(zip(values, _shorten(values.values()), strict=True))
        for kind, values in (("costs", run.costs), ("training", run.training))
    }
    return {"origin": origin, "clips": _digest(_clips(run))[:8], **numbers, "errors": errors}


def _clips(run: Measured) -> list[list[str]]:
    """Return the names of the test clips, each with its group, and with its source if there are several."""
    sources = run.clip_sources
    return [[name, run.group(name), *([sources[name]] if sources else [])] for name in run.clips]


def _shorten(values: Iterable[float]) -> list[float | str | None]:
    """Return numbers rounded to six digits; None for NaN, and infinity as a word."""
    short = [float(f"{float(value):.{DIGITS}g}") for value in values]
    return [None if math.isnan(value) else value if math.isfinite(value) else str(value) for value in short]


def _measured(name: str, record: Mapping[str, Any], clips: Sequence[Sequence[str]]) -> Measured:
    """Return a run from its record in the file."""
    names, errors = [clip for clip, *_ in clips], record["errors"]
    of_clips: dict[str, Errors] = {name: {mode: {} for mode in errors} for name in names}
    for mode, branches in errors.items():
        for branch, metrics in branches.items():
            rows = zip(*metrics.values(), strict=True) if metrics else [()] * len(names)
            for clip, row in zip(names, rows, strict=True):
                of_clips[clip][mode][branch] = dict(zip(metrics, row, strict=True))  # type: ignore[index]
    measured = Measured(
        id=name.partition("/")[0],
        means=errors,
        clips=of_clips,
        groups={clip: group for clip, group, *_ in clips},
        clip_sources={clip: source[0] for clip, _, *source in clips if source},
        costs=record["costs"],
        origin=Origin(**record["origin"]),
        training=record["training"],
    )
    return measured.over(names)
