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
from memmlp.common.files import atomic_write, make_json_safe
from memmlp.report.tables.effects import RunsBySeed
from memmlp.report.tables.measured_run import Errors, Measured, Origin
from memmlp.sweep.definition import Sweep

DIGITS = 6
FLAT_LIST = re.compile(r"\[\n([^\[\]{}]*?)\n *\]")  # of plain values; no string contains a line break
DEFAULT_ORIGIN = make_json_safe(asdict(Origin(code="", changed=False, data="", hardware="")))
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
    def every(self) -> list[Measured]:
        """The runs, once for each evaluation and deployment that variants show, sorted by name."""
        return [run for _, run in sorted(self.named.items())]

    @property
    def count(self) -> int:
        """The number of runs."""
        return len({run.id for run in self.every})

    @property
    def untrained(self) -> int:
        """The number of networks whose costs were measured without a run."""
        return len({run.id for run in self.every if not run.means})

    @cached_property
    def named(self) -> dict[str, Measured]:
        """The runs by their names in the file."""
        return {self.names[id(run)]: run for by_seed in self.runs.values() for run in by_seed.values()}

    @cached_property
    def names(self) -> dict[int, str]:
        """The runs' names in the file, by their objects' `id()`.

        A name is the run's id. If variants show several evaluations or deployments of one run, a digest of
        its record is appended.
        """
        by_id: dict[str, dict[int, Measured]] = defaultdict(dict)
        for run in (run for by_seed in self.runs.values() for run in by_seed.values()):
            by_id[run.id][id(run)] = run
        names: dict[int, str] = {}
        for run_id, runs in by_id.items():
            ends = [f"/{_digest(_record(run))[:8]}" if len(runs) > 1 else "" for run in runs.values()]
            several = len(set(ends)) > 1
            names |= {key: f"{run_id}{end * several}" for key, end in zip(runs, ends, strict=True)}
        return names

    def check_replaces(self, other: Kept) -> None:
        """Check that writing these results over others loses none of them.

        Raises:
            InputError: if the others are of another sweep or other overrides, or have further runs.
        """
        if (self.sweep, self.overrides) != (other.sweep, other.overrides):
            raise InputError(f"has the results of '{other.command}', not of '{self.command}'")
        lost = [
            f"'{label}' seed {seed}"
            for label, runs in other.runs.items()
            for seed in runs
            if seed not in self.runs.get(label, {})
        ]
        if lost:
            raise InputError(f"has results of runs that are not here: {', '.join(lost[:12])}")

    @property
    def sources(self) -> tuple[str, ...]:
        """The names of the sources of the test clips; empty if there is only one source."""
        return tuple(sorted({source for run in self.every for source in run.clip_sources.values()}))

    def runs_of(self, sweep: Sweep) -> dict[str, RunsBySeed]:
        """Return the runs of the variants and seeds that the sweep has now.

        Raises:
            InputError: if a variant has other overrides now, so that its runs belong to another variant with
                the same label.
        """
        for label, overrides in list_overrides(sweep).items():
            if self.runs.get(label) and self.variants.get(label, overrides) != overrides:
                before, now = (", ".join(one) or "none" for one in (self.variants[label], overrides))
                raise InputError(f"variant '{label}' was made with the overrides {before}, and now has {now}")
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
        for key, value in make_json_safe(asdict(run.origin)).items()
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
