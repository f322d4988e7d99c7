"""What may be claimed about many comparisons, at once or in interim analyses at a growing number of seeds."""

from __future__ import annotations

import itertools
from enum import StrEnum

import numpy as np

from memmlp.report.tables.statistics.paired_differences import LEVEL


class Verdict(StrEnum):
    """What is claimed about a comparison.

    HOLDS and OPPOSITE are about the paper's effect, HIGHER and LOWER about the measured difference if the
    paper has no effect. INCONCLUSIVE claims nothing.
    """

    HOLDS = "holds"
    OPPOSITE = "opposite"
    HIGHER = "higher"
    LOWER = "lower"
    EQUIVALENT = "equivalent"
    INCONCLUSIVE = "inconclusive"


def holm(p: np.ndarray) -> np.ndarray:
    """Correct p-values (K,) for their number by Holm's step-down method; NaN stays NaN and does not count.

    The probability of any wrong claim of a difference stays below the level (Holm 1979).
    """
    p = np.asarray(p, float)
    order = np.flatnonzero(~np.isnan(p))
    order = order[np.argsort(p[order])]
    corrected = np.full_like(p, np.nan)
    corrected[order] = np.minimum(1, np.maximum.accumulate(p[order] * np.arange(len(order), 0, -1)))
    return corrected


def verdict(
    difference: float, equivalence: float, mean: float, paper: float | None = None, level: float = LEVEL
) -> Verdict:
    """Return the verdict on one comparison of a table.

    Claims of a difference and claims of equivalence are two families, each with 5 % for a wrong claim: they
    answer different questions, and a mean can't be wrongly called both. An interval within the margin shows
    that there is no effect of interest, even if it does not contain 0.

    Args:
        difference: the p-value of a difference, corrected over the table; NaN if undefined.
        equivalence: the p-value of `equivalence_p`, corrected in the same way.
        mean: the measured mean difference.
        paper: the paper's difference; None or 0 if the paper claims no sign.
        level: the level that either family may spend, less than 5 % for an interim analysis.
    """
    if equivalence <= level:
        return Verdict.EQUIVALENT
    if not difference <= level:
        return Verdict.INCONCLUSIVE
    if paper:
        return Verdict.HOLDS if mean * paper > 0 else Verdict.OPPOSITE
    return Verdict.HIGHER if mean > 0 else Verdict.LOWER


def analysis_schedule(most: int) -> tuple[int, ...]:
    """Return the numbers of seeds of the interim analyses: 3, 5, 8, 13, ... up to `most`.

    Two seeds never decide anything at the levels of a table, so the first one is at three.
    """
    counts = [3, 5]
    while counts[-1] < most:
        counts.append(counts[-1] + counts[-2])
    return (*itertools.takewhile(lambda count: count < most, counts), most)


def spending(number: int) -> tuple[float, ...]:
    """Return the level that each of `number` interim analyses may spend.

    Together they are 5 %, so that nothing need be assumed about how the analyses depend on each other. Each
    level is twice the one before: among weights growing by a factor of 1, 2 or 3, these lose few decisions
    and cost few seeds.
    """
    weights = 2.0 ** np.arange(number)
    return tuple(map(float, LEVEL * weights / weights.sum()))


def sequential(p: np.ndarray, claimed: np.ndarray, closed: np.ndarray) -> np.ndarray:
    """Correct p-values (K,) by Holm at an interim analysis; compare them with the analysis' level.

    What was decided stays decided. Comparisons that this family has claimed are removed from the correction
    of the others. Comparisons that are closed without such a claim, because the other family decided them or
    their variant has stopped, stay in the correction, but can no longer be claimed. So a first wrong claim
    needs a true null whose p-value is below the analysis' level over the number of nulls, at an analysis that
    was fixed beforehand: the levels add up.

    Args:
        p: p-values (K,) of this analysis; NaN if undefined, which never decides.
        claimed: what this family claimed at earlier analyses, (K,) bool.
        closed: which comparisons are closed without such a claim, (K,) bool.
    """
    return holm(np.where(claimed, 0.0, np.where(closed, 1.0, p)))
