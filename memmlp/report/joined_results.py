"""Joins kept results of one sweep: those of other seeds, and those of other splits of the persons."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any

import numpy as np

from memmlp.common.errors import InputError
from memmlp.report.kept_results import KeptResults
from memmlp.report.tables.effects import RunsBySeed
from memmlp.report.tables.measured_run import Errors, MeasuredRun, join_origins
from memmlp.sweep.definition import parse_key

SPLIT_KEY = "data.split.seed"
WARNINGS = ("partial", "divided", "resampled", "unusual")  # texts of an origin


def join_results(parts: Sequence[KeptResults]) -> KeptResults:
    """Join kept results of one sweep.

    Results with equal overrides are joined by variant and seed, also those with equal pooled splits. Results
    that differ in `data.split.seed` are pooled: a joined run is the trainings of a variant and seed with all
    splits, and its test clips are those of all splits. A clip of several splits has its mean error. Variants
    and seeds that lack a split are left out, with a flag.

    Raises:
        InputError: if the results have other sweeps, overrides or variants, or seed rounds; if some of them,
            but not all, are pooled; if a variant and seed has several runs; or if the runs of several splits
            have the same test clips, other groups or other component versions.
    """
    variants: dict[str, tuple[str, ...]] = {}
    for one in parts:
        if (one.sweep, _drop_split(one.overrides)) != (parts[0].sweep, _drop_split(parts[0].overrides)):
            raise InputError(f"'{one.command}': must be '{parts[0].command}', or differ only in {SPLIT_KEY}")
        for label, overrides in one.variants.items():
            if variants.setdefault(label, overrides) != overrides:
                raise InputError(f"variant '{label}': its overrides differ between the results")
    if len(parts) < 2 or any(one == parts[0] for one in parts[1:]):
        raise InputError("results join: needs at least two different results")
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
        if run.origin.data != (first := next(iter(runs[label].values()))).origin.data:
            raise InputError(f"'{label}': run {run.id} has other data than run {first.id}")
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
            try:
                runs[label] = {**runs[label], seed: _pool_runs(trained)}
            except InputError as error:
                raise InputError(f"'{label}' seed {seed}: {error}") from None
    if not runs:
        raise InputError(f"{SPLIT_KEY}: no variant and seed has runs of all splits")
    keys = {key for found in by_split for key in found if not all(key in other for other in by_split)}
    lacking = [f"'{label}' seed {seed}" for label, seed in sorted(keys)]
    left_out = (f"left out, because runs of a split are missing: {', '.join(lacking)}",) if lacking else ()
    splits = tuple(
        next((text for text in one.overrides if parse_key(text) == SPLIT_KEY), "") for one in parts
    )
    return replace(
        parts[0],
        overrides=_drop_split(parts[0].overrides),
        runs=runs,
        variants={label: parts[0].variants[label] for label in runs},
        flags=(*dict.fromkeys(flag for one in parts for flag in one.flags), *left_out),
        splits=splits,
    )


def _pool_runs(runs: Sequence[MeasuredRun]) -> MeasuredRun:
    """Return the trainings of a variant and seed with several splits as one run, with the first's costs."""
    origins = [run.origin for run in runs]
    groups = {clip: group for run in runs for clip, group in run.groups.items()}
    if len({tuple(sorted(run.clips)) for run in runs}) < len(runs):
        raise InputError("two splits have the same test clips; their persons must differ")
    if any(groups[clip] != group for run in runs for clip, group in run.groups.items()):
        raise InputError("the groups of test clips must be the same in all splits")
    versions = {item for origin in origins for item in origin.component_versions.items()}
    if len(versions) > len(dict(versions)) or len({(one.precision, one.body) for one in origins}) > 1:
        raise InputError("component versions, precision and body must be the same in all splits")
    warnings: dict[str, Any] = {
        key: "; ".join(dict.fromkeys(filter(None, map(attrgetter(key), origins)))) or None for key in WARNINGS
    }
    data = ", ".join(dict.fromkeys(origin.data for origin in origins))
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
        groups=groups,
        clip_sources={clip: source for run in runs for clip, source in run.clip_sources.items()},
        origin=replace(join_origins(origins[0], origins[1:]), data=data, **warnings),
        run=None,
    )
    return pooled.restrict_to_clips(list(clips))


def _average(errors: Sequence[Any]) -> Any:
    """Return the mean of nested errors that all have; NaN where one of them has no value."""
    if isinstance(errors[0], Mapping):
        shared = [key for key in errors[0] if all(key in one for one in errors)]
        return {key: _average([one[key] for one in errors]) for key in shared}
    return float(np.mean([np.nan if value is None else float(value) for value in errors]))
