"""Statistics of differences between two variants that were run with the same seeds and tested on the same
clips.

`differences` are always (K, S, C): for each of K comparisons, one variant's error minus the other's, for seed
s on clip c. `crossed` estimates the error of their mean, to which seeds and groups of clips contribute.
`paired_differences` turns it into intervals and p-values. `power` says which effects could have been found,
`verdicts` what may be claimed about many comparisons, in one look or in several, and `robust` describes
errors without testing. docs/statistics.md explains the method and how well it keeps its promises.
"""

from __future__ import annotations

from memmlp.tables.statistics.paired_differences import (
    EffectEstimates,
    equivalence_p,
    paired_effects,
    seed_effects,
)
from memmlp.tables.statistics.power import detectable, seeds_needed
from memmlp.tables.statistics.robust import (
    interquartile_mean,
    performance_profile,
    probability_of_improvement,
)
from memmlp.tables.statistics.verdicts import Verdict, holm, looks, sequential, spending, verdict

__all__ = [
    "EffectEstimates",
    "Verdict",
    "detectable",
    "equivalence_p",
    "holm",
    "interquartile_mean",
    "looks",
    "paired_effects",
    "performance_profile",
    "probability_of_improvement",
    "seed_effects",
    "seeds_needed",
    "sequential",
    "spending",
    "verdict",
]
