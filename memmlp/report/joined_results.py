"""Joins kept results of one sweep: those of other seeds, and those of other splits of the persons."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from memmlp.common.errors import InputError
from memmlp.report.kept_results import KeptResults
from memmlp.report.tables.effects import RunsBySeed
from memmlp.report.tables.measured_run import Errors, MeasuredRun, join_origins
from memmlp.sweep.definition import parse_key

SPLIT_KEY = "data.split.seed"


def join_results(parts: Sequence[KeptResults]) -> KeptResults:
    """Join kept results of one sweep.

    Results with equal overrides are joined by variant and seed, also those with equal pooled splits. Results
    that differ in `data.split.seed` are pooled: a joined run is the trainings of a variant and seed with all
    splits, and its test clips are those of all splits. A clip of several splits has its mean error. Variants
    and seeds that lack a split are left out.

    Raises:
        InputError: if the results have other sweeps, overrides or variants, or seed rounds; if some of them,
            but not all, are pooled; or if a variant and seed has several runs.
    """
    for one, other in pairwise(parts):
        if (one.sweep, _drop_split(one.overrides)) != (other.sweep, _drop_split(other.overrides)):
            raise InputError(f"'{other.command}': must be '{one.command}', or differ only in {SPLIT_KEY}")
        for label in one.variants.keys() & other.variants.keys():
            if one.variants[label] != other.variants[label]:
                raise InputError(f"variant '{label}': its overrides differ between the results")
    if any(one.rounds for one in parts):
        raise InputError("results of --until-decided cannot be joined")
    by_split: dict[tuple[str, ...], list[KeptResults]] = defaultdict(list)
    for one in parts:
        by_split[(*one.overrides, *one.splits)].append(one)
    if len(by_split) > 1 and any(one.splits for one in parts):
        raise InputError("pooled results can only be joined with results that pool the same splits")
    joined = [_join_seeds(found) for found in by_split.values()]
    return joined[0] if len(joined) == 1 else _pool_splits(joined)


def _drop_split(overrides: Sequence[str]) -> tuple[str, ...]:
    return tuple(text for text in overrides if parse_key(text) != SPLIT_KEY)


def _join_seeds(parts: Sequence[KeptResults]) -> KeptResults:
    runs: dict[str, dict[int, MeasuredRun]] = defaultdict(dict)
    for label, seed, run in ((*key, run) for one in parts for key, run in _list_runs(one)):
        if runs[label].setdefault(seed, run).id != run.id:
            raise InputError(f"'{label}' seed {seed}: has two runs, {runs[label][seed].id} and {run.id}")
    variants = {label: texts for one in parts for label, texts in one.variants.items()}
    flags = tuple(dict.fromkeys(flag for one in parts for flag in one.flags))
    return replace(parts[0], runs=runs, variants=variants, flags=flags)


def _list_runs(kept: KeptResults) -> list[tuple[tuple[str, int], MeasuredRun]]:
    return [((label, seed), run) for label, runs in kept.runs.items() for seed, run in runs.items()]


def _pool_splits(parts: Sequence[KeptResults]) -> KeptResults:
    by_split = [dict(_list_runs(one)) for one in parts]
    runs: dict[str, RunsBySeed] = defaultdict(dict)
    for label, seed in by_split[0]:
        if all((label, seed) in found for found in by_split):
            trained = [found[label, seed] for found in by_split]
            if len({run.id for run in trained}) < len(trained):
                raise InputError(f"'{label}' seed {seed}: two splits have the same run; they must differ")
            runs[label] = {**runs[label], seed: _pool_runs(trained)}
    splits = tuple(
        next((text for text in one.overrides if parse_key(text) == SPLIT_KEY), "") for one in parts
    )
    return replace(
        parts[0],
        overrides=_drop_split(parts[0].overrides),
        runs=runs,
        variants={label: parts[0].variants[label] for label in runs},
        flags=tuple(dict.fromkeys(flag for one in parts for flag in one.flags)),
        splits=splits,
    )


def _pool_runs(runs: Sequence[MeasuredRun]) -> MeasuredRun:
    """Return the trainings of a variant and seed with several splits as one run, with the first's costs."""
    by_clip: dict[str, list[Errors]] = defaultdict(list)
    for run in runs:
        for clip, errors in run.clips.items():
            by_clip[clip].append(errors)
    clips = {clip: _average(found) for clip, found in sorted(by_clip.items())}
    pooled = replace(
        runs[0],
        id="+".join(run.id for run in runs),
        clips=clips,
        means=next(iter(clips.values())),  # restrict_to_clips computes their values
        groups={clip: group for run in runs for clip, group in run.groups.items()},
        clip_sources={clip: source for run in runs for clip, source in run.clip_sources.items()},
        origin=join_origins(runs[0].origin, [run.origin for run in runs[1:]]),
        run=None,
    )
    return pooled.restrict_to_clips(list(clips))


def _average(errors: Sequence[Any]) -> Any:
    """Return the mean of nested errors that all have; NaN where one of them has no value."""
    if isinstance(errors[0], Mapping):
        shared = [key for key in errors[0] if all(key in one for one in errors)]
        return {key: _average([one[key] for one in errors]) for key in shared}
    return float(np.mean([np.nan if value is None else float(value) for value in errors]))
