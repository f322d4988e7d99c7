"""How many seeds the paper's printed effects would need here, estimated from the present runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from memmlp.sweep.definition import MODES, Sweep
from memmlp.tables.effects import RunsBySeed, paired, paper_effect, testable, with_existing_branches
from memmlp.tables.statistics import seeds_needed


class Need(NamedTuple):
    """What a comparison would need for an effect of the paper's size to be seen with 80 % power.

    Attributes:
        label, mode, metric: which comparison it is.
        paper: the paper's difference.
        measured: the measured mean difference.
        have: the number of seeds so far.
        seeds: the number of seeds needed; None if no number of seeds would be enough with these clips.
    """

    label: str
    mode: str
    metric: str
    paper: float
    measured: float
    have: int
    seeds: int | None


def needs(sweep: Sweep, runs: Mapping[str, RunsBySeed], modes: Sequence[str] = MODES) -> list[Need]:
    """Return the needs of all variants and metrics whose effects the paper prints, in the table's order.

    The correction is over the comparisons that the runs allow today, in both modes, as a table's is. A
    comparison without a p-value, such as that of a variant with one seed, is left out.

    Args:
        sweep: the sweep.
        runs: the finished runs of every runnable variant, by seed.
        modes: the modes of evaluation whose comparisons are returned.
    """
    seen = with_existing_branches(sweep, runs)
    pairs, variants = paired(seen, runs, MODES), {variant.label: variant for variant in seen.variants}
    found, comparisons = [], testable(pairs)
    for key, pair in pairs.items():
        effect = paper_effect(seen, variants[key.label], key.metric)
        if effect and key.mode in modes and pair.testable:
            number = seeds_needed(pair.matrix, effect, comparisons, pair.groups)
            found.append(Need(*key, effect, float(pair.matrix.mean()), len(pair.matrix), number))
    return found
