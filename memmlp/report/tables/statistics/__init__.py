"""Statistics of differences between two variants that were run with the same seeds and tested on the same
clips.

`differences` are always (K, S, C): for each of K comparisons, one variant's error minus the other's, for seed
s on clip c. `paired_differences` has intervals and p-values, `power` the effects that could have been found,
`verdicts` what may be claimed about many comparisons, at once or in interim analyses. docs/statistics.md
explains the method and how well it keeps its promises.
"""

from __future__ import annotations

from memmlp.report.tables.statistics.paired_differences import (
    EffectEstimates,
    equivalence_p,
    paired_effects,
    seed_effects,
)
from memmlp.report.tables.statistics.power import detectable, seeds_needed
from memmlp.report.tables.statistics.verdicts import (
    Verdict,
    analysis_schedule,
    holm,
    sequential,
    spending,
    verdict,
)

__all__ = [
    "EffectEstimates",
    "Verdict",
    "analysis_schedule",
    "detectable",
    "equivalence_p",
    "holm",
    "paired_effects",
    "seed_effects",
    "seeds_needed",
    "sequential",
    "spending",
    "verdict",
]
