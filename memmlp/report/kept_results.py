"""A sweep's finished runs in compact form: per-clip errors, costs and origins, in one JSON file.

Tables and intervals can be recomputed from the file without training. Equal results give equal bytes: runs
are sorted by id, and numbers have six significant digits.
"""

from __future__ import annotations

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
from memmlp.common.files import atomic_write, digest, make_json_safe
from memmlp.common.text_formats import join_command
from memmlp.report.tables.effects import RunsBySeed
from memmlp.report.tables.measured_run import Errors, MeasuredRun, Origin
from memmlp.sweep.definition import Sweep

SIGNIFICANT_DIGITS = 6
LIST_OF_VALUES = re.compile(r"\[\n([^\[\]{}]*?)\n *\]")  # strings contain no line breaks
DEFAULT_ORIGIN = make_json_safe(asdict(Origin(code="", changed=False, data="", hardware="")))
REQUIRED_FACTS = ("code", "changed", "data", "hardware")  # facts of an origin that the file always contains


@dataclass(frozen=True)
class KeptResults:
    """The kept results of a sweep.

    Attributes:
        sweep: the SWEEP argument of commands: a name or a file.
        overrides: the command line's overrides.
        runs: the finished runs by variant label and seed.
        variants: the overrides of each variant by label.
        rounds: the seed rounds (`Rounds`) as JSON; None for a fixed number of seeds.
        flags: warnings about how the seeds were chosen.
        splits: if the test clips of several splits are pooled, each split's override; "" for that of
            `overrides`. The id of a pooled run is those of its trainings, with a plus between.
        weigh_groups: whether the table gives each group of test clips the same weight.
    """

    sweep: str
    overrides: tuple[str, ...]
    runs: Mapping[str, RunsBySeed]
    variants: Mapping[str, tuple[str, ...]]
    rounds: Mapping[str, Any] | None = None
    flags: tuple[str, ...] = ()
    splits: tuple[str, ...] = ()
    weigh_groups: bool = False

    @property
    def command(self) -> str:
        """The command that repeats the runs."""
        return join_command(["memmlp", "sweep", self.sweep, *self.overrides])

    @property
    def command_for_all_splits(self) -> str:
        """The command, and what to add to it for the runs of each other split."""
        others = [split for split in self.splits if split]
        return f"{self.command}, and again with {', '.join(others)}" if others else self.command

    @property
    def all_runs(self) -> list[MeasuredRun]:
        """The runs sorted by name; a run appears once for each of its evaluations and deployments."""
        return [run for _, run in sorted(self.runs_by_name.items())]

    @property
    def run_count(self) -> int:
        """The number of runs."""
        return len({name for run in self.all_runs for name in run.id.split("+")})

    @property
    def untrained_count(self) -> int:
        """The number of untrained networks: only their costs were measured."""
        return len({run.id for run in self.all_runs if not run.means})

    @cached_property
    def runs_by_name(self) -> dict[str, MeasuredRun]:
        """The runs by their names in the file."""
        return {self.run_names[id(run)]: run for by_seed in self.runs.values() for run in by_seed.values()}

    @cached_property
    def run_names(self) -> dict[int, str]:
        """The name of each run in the file, by `id(run)`.

        A name is the run's id. If the file has several evaluations or deployments of a run, a digest of the
        record is appended.
        """
        by_id: dict[str, dict[int, MeasuredRun]] = defaultdict(dict)
        for by_seed in self.runs.values():
            for run in by_seed.values():
                by_id[run.id][id(run)] = run
        names: dict[int, str] = {}
        for run_id, runs in by_id.items():
            ends = [f"/{digest(_make_record(run))[:8]}" if len(runs) > 1 else "" for run in runs.values()]
            several = len(set(ends)) > 1
            names |= {key: f"{run_id}{end * several}" for key, end in zip(runs, ends, strict=True)}
        return names

    def check_can_replace(self, other: KeptResults) -> None:
        """Check that these results can replace older ones without losing runs.

        Raises:
            InputError: if the older results have other overrides, another sweep or additional runs.
        """
        if (self.sweep, self.overrides, self.splits) != (other.sweep, other.overrides, other.splits):
            own = self.command_for_all_splits
            raise InputError(f"contains results of '{other.command_for_all_splits}', not of '{own}'")
        lost = [
            f"'{label}' seed {seed} (run {run.id})"
            for label, runs in other.runs.items()
            for seed, run in runs.items()
            if (new := self.runs.get(label, {}).get(seed)) is None or (run.means and new.id != run.id)
        ]
        if lost:
            raise InputError(f"contains results of runs that were not found: {', '.join(lost[:12])}")

    @property
    def sources(self) -> tuple[str, ...]:
        """The names of the test clips' sources; empty if there is only one source."""
        return tuple(sorted({source for run in self.all_runs for source in run.clip_sources.values()}))

    def select_runs(self, sweep: Sweep) -> dict[str, RunsBySeed]:
        """Return the runs of the sweep's current variants and seeds.

        Raises:
            InputError: if the overrides of a variant have changed, so its kept runs no longer belong to it.
        """
        for label, overrides in list_overrides(sweep).items():
            if self.runs.get(label) and self.variants.get(label, overrides) != overrides:
                before, now = (", ".join(one) or "none" for one in (self.variants[label], overrides))
                raise InputError(f"variant '{label}': overrides changed from {before} to {now}")
        return {
            variant.label: {
                seed: run
                for seed, run in sorted(self.runs.get(variant.label, {}).items())
                if seed in sweep.get_seeds(variant)
            }
            for variant in sweep.list_runnable()
        }


def list_overrides(sweep: Sweep) -> dict[str, tuple[str, ...]]:
    """Return each variant's overrides from the sweep file, including the base overrides."""
    bare = replace(sweep, command_line=())
    return {variant.label: shorten_paths(bare.merge_overrides(variant)) for variant in sweep.list_runnable()}


def shorten_paths(overrides: Iterable[str]) -> tuple[str, ...]:
    """Shorten absolute paths in overrides to the last part, because they differ between machines."""
    path = re.compile(r"(?<==)/\S*|(?<=file://)/[^\s,\]]*")
    return tuple(path.sub(lambda found: f".../{PurePath(found[0]).name}", text) for text in overrides)


def save_results(path: Path, kept: KeptResults) -> None:
    """Write a results file, completely or not at all. Raises InputError if this fails."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(path, format_results(kept))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None


def format_results(kept: KeptResults) -> str:
    """Return the text of a results file."""
    content = {
        "sweep": kept.sweep,
        "overrides": list(kept.overrides),
        "command": kept.command,
        "variants": {label: list(overrides) for label, overrides in sorted(kept.variants.items())},
        "rounds": kept.rounds,
        "flags": list(kept.flags),
        **({"splits": list(kept.splits)} if kept.splits else {}),
        **({"weigh_groups": True} if kept.weigh_groups else {}),
        "clips": dict(
            sorted({digest(_list_clips(run))[:8]: _list_clips(run) for run in kept.all_runs}.items())
        ),
        "cells": {
            label: {str(seed): kept.run_names[id(runs[seed])] for seed in sorted(runs)}
            for label, runs in sorted(kept.runs.items())
            if runs
        },
        "runs": {name: _make_record(run) for name, run in sorted(kept.runs_by_name.items())},
    }
    content["digest"] = digest(content)[:16]
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    return LIST_OF_VALUES.sub(lambda match: f"[{' '.join(map(str.strip, match[1].splitlines()))}]", text)


def load_kept_results(path: Path) -> KeptResults:
    """Read a results file. Raises InputError if it is damaged, or was edited by hand."""
    try:
        content = json.loads(path.read_bytes())
        if content.pop("digest", None) != digest(content)[:16]:
            raise ValueError("edited by hand: its digest is missing or wrong")
        runs = {
            name: _parse_record(name, record, content["clips"][record["clips"]])
            for name, record in content["runs"].items()
        }
        cells = {
            label: {int(seed): runs[name] for seed, name in seeds.items()}
            for label, seeds in content["cells"].items()
        }
        return KeptResults(
            content["sweep"],
            tuple(content["overrides"]),
            cells,
            {label: tuple(texts) for label, texts in content["variants"].items()},
            content["rounds"],
            tuple(content["flags"]),
            tuple(content.get("splits", ())),
            content.get("weigh_groups", False),
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: damaged ({error}); write it again with memmlp results save") from None


def _make_record(run: MeasuredRun) -> dict[str, Any]:
    """Return a run's record in the file: origin, costs, and the metrics of each test clip."""
    names = list(run.clips)
    origin = {
        key: value
        for key, value in make_json_safe(asdict(run.origin)).items()
        if key in REQUIRED_FACTS or value != DEFAULT_ORIGIN[key]
    }
    errors = {
        mode: {
            branch: {
                metric: [*map(_round_number, run.get_clip_values(names, mode, branch, metric))]
                for metric in metrics
            }
            for branch, metrics in branches.items()
        }
        for mode, branches in run.means.items()
    }
    return {
        "origin": origin,
        "clips": digest(_list_clips(run))[:8],
        "costs": {name: _round_number(cost) for name, cost in run.costs.items()},
        "training": {name: _round_number(cost) for name, cost in run.training.items()},
        "errors": errors,
    }


def _list_clips(run: MeasuredRun) -> list[list[str]]:
    """Return [name, group] of each test clip; [name, group, source] if there are several sources."""
    sources = run.clip_sources
    return [[name, run.get_group(name), *([sources[name]] if sources else [])] for name in run.clips]


def _round_number(value: float) -> float | str | None:
    """Round to six significant digits; NaN becomes None, and infinity becomes "inf"."""
    short = float(f"{float(value):.{SIGNIFICANT_DIGITS}g}")  # an infinity from a file is a text
    return None if math.isnan(short) else short if math.isfinite(short) else str(short)


def _parse_record(name: str, record: Mapping[str, Any], clips: Sequence[Sequence[str]]) -> MeasuredRun:
    names, errors = [clip for clip, *_ in clips], record["errors"]
    by_clip: dict[str, Errors] = {name: {mode: {} for mode in errors} for name in names}
    for mode, branches in errors.items():
        for branch, metrics in branches.items():
            rows = zip(*metrics.values(), strict=True) if metrics else [()] * len(names)
            for clip, row in zip(names, rows, strict=True):
                by_clip[clip][mode][branch] = dict(zip(metrics, row, strict=True))  # type: ignore[index]
    measured = MeasuredRun(
        id=name.partition("/")[0],
        means=errors,
        clips=by_clip,
        groups={clip: group for clip, group, *_ in clips},
        clip_sources={clip: source[0] for clip, _, *source in clips if source},
        costs=record["costs"],
        origin=Origin(**record["origin"]),
        training=record["training"],
    )
    return measured.restrict_to_clips(names)
