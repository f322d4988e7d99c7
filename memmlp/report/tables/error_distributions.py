"""The errors behind a table's means, as distributions over seeds and clips.

A few extreme clips can't dominate these descriptions. Source: Agarwal et al. 2021, "Deep reinforcement
learning at the edge of the statistical precipice" (the library rliable).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from memmlp.evaluation.metric_facts import HIGHER
from memmlp.report.tables.effects import RunsBySeed, control_variant, with_existing_branches
from memmlp.sweep.definition import COSTS, Sweep, Variant


class Distribution(NamedTuple):
    """A variant's errors in one metric.

    Attributes:
        label: the variant's label.
        errors: the errors (S, C) by seed and clip, infinite where the network diverged; empty if there are
            none.
        middle: the errors' interquartile mean; None if there are none.
        improvement: the probability that a run of the variant has a better value than one of its control on
            the same clip: a smaller error, or a larger value of a metric for which higher is better; None
            without a control or a shared clip.
    """

    label: str
    errors: np.ndarray
    middle: float | None
    improvement: float | None


def distributions(sweep: Sweep, runs: Mapping[str, RunsBySeed], mode: str) -> dict[str, list[Distribution]]:
    """Return the distributions of every variant, by metric, over the clips that all runs have.

    A clip for which a run has no number, while another run has one, is one on which its network diverged: its
    error counts as infinite, for otherwise a variant that diverges on hard clips would look better for it.
    Metrics that no run has are left out.
    """
    seen = with_existing_branches(sweep, runs)
    every = [run for found in runs.values() for run in found.values()]
    clips = [clip for clip in every[0].clips if all(clip in run.clips for run in every)] if every else []
    metrics = [metric for metric in sweep.metrics if metric not in COSTS]
    found = {metric: _of_metric(seen, runs, clips, mode, metric) for metric in metrics}
    return {metric: rows for metric, rows in found.items() if any(row.errors.size for row in rows)}


def _of_metric(
    sweep: Sweep, runs: Mapping[str, RunsBySeed], clips: list[str], mode: str, metric: str
) -> list[Distribution]:
    variants = [variant for variant in sweep.runnable() if runs[variant.label]]
    sign = -1 if metric in HIGHER else 1
    errors = {
        variant.label: _errors(runs[variant.label], clips, mode, variant, metric) for variant in variants
    }
    long_enough = np.isfinite(np.concatenate([*errors.values(), np.empty((0, len(clips)))])).any(0)
    for label, found in errors.items():
        known = found[:, long_enough]
        errors[label] = np.where(np.isfinite(known), known, sign * np.inf)
    return [
        _distribution(variant.label, errors, control_variant(sweep, variant), sign) for variant in variants
    ]


def _errors(runs: RunsBySeed, clips: list[str], mode: str, variant: Variant, metric: str) -> np.ndarray:
    """Return the errors (S, C) of the runs that have the metric, with NaN for clips without a number."""
    having = [run for run in runs.values() if run.value(mode, variant.branch, metric) is not None]
    found = [run.by_clip(clips, mode, variant.branch, metric) for run in having]
    return np.array(found).reshape(len(found), len(clips))


def _distribution(
    label: str, errors: Mapping[str, np.ndarray], other: Variant | None, sign: int
) -> Distribution:
    """Return a variant's distribution from all errors (S, C); `sign` is -1 if larger is better."""
    ours, theirs = errors[label], errors.get(other.label) if other else None
    middle = interquartile_mean(ours) if ours.size else None
    if theirs is None or not ours.size or not theirs.size:
        return Distribution(label, ours, middle, None)
    improvement = probability_of_improvement(*(np.nan_to_num(sign * side) for side in (ours, theirs)))
    return Distribution(label, ours, middle, improvement)


def probability_of_improvement(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Return how often one of our runs (S, C) has a smaller error than one of theirs (T, C) on a clip.

    All pairs of seeds are compared on each clip; a tie counts half.
    """
    difference = theirs[None] - ours[:, None]
    return float(((np.sign(difference) + 1) / 2).mean())


def interquartile_mean(errors: np.ndarray) -> float:
    """Return the mean of the middle half of all errors (S, C)."""
    from scipy.stats import trim_mean  # slow to import

    return float(trim_mean(errors, 0.25, axis=None))


def performance_profile(errors: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """Return, for each threshold (N,), the fraction of errors (S, C) that are at most as large."""
    return (errors.reshape(-1, 1) <= thresholds).mean(0)
