"""Statistics of differences between two variants with the same seeds and the same test clips.

`differences` are always (K, S, C): for each of K comparisons, one variant's error minus the other's, for seed
s on clip c. First come intervals and p-values, then the effects that could have been found, then what may be
claimed about many comparisons. docs/statistics.md explains the method and how well it keeps its promises.

Seeds and groups of clips are crossed: every seed saw every clip. The model is d[s, c] = mean + effect of seed
s + effect of c's group + effect of clip c + noise, with unknown variances. Clips are first averaged within
their groups (takes, subjects), because the groups are what was replicated. The mean stays the one over clips,
so that a group weighs w[g], its share of the clips. The means m[s, g] give three variances, with these
degrees of freedom:

    A = variance of the S seeds' means / S                                    S - 1
    B = variance of the G groups' means x sum of w^2                          G - 1
    E = variance of what neither explains x sum of w^2 / S                    (S - 1) (G - 1)

A + B - E estimates the variance of the mean, because the noise is contained in both A and B. (Where groups
differ in size, B is larger than it should be if clips differ more than groups, and smaller if the larger
groups have the larger effects.)
"""

from __future__ import annotations

import bisect
import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, ndtri, stdtr, stdtrit

LEVEL = 0.05
DRAWS = 4096  # simulated tables; a power of two, as Sobol's sequence wants

Groups = np.ndarray | Sequence[object] | None
"""The group of each clip (C,), as integers or labels; None if each clip is a group of its own."""

TRUST = 5.0
"""How much of B may count as noise that is not skewed: at most TRUST x level x E.

It was measured by simulation; see `Error.half` and docs/statistics.md.
"""


@dataclass(frozen=True)
class Error:
    """The estimated errors of K means.

    Args:
        variances: A, B and E of the module's docstring, (3, K). With a single seed or group, its variance is
            0, and so is E.
        seeds: degrees of freedom of A.
        groups: degrees of freedom of B.
        conditional: what there is only one of, so that nothing can be said about others: "seeds", "clips",
            "seeds and clips", or "" if there are several of both.
    """

    variances: np.ndarray
    seeds: float
    groups: float
    conditional: str = ""

    @property
    def parts(self) -> np.ndarray:
        """The parts (3, K) of seeds, groups and noise in the variances of the means."""
        seeds, clips, noise = self.variances
        return np.stack([np.maximum(seeds - noise, 0), np.maximum(clips - noise, 0), noise])

    def half(self, level: float | np.ndarray) -> np.ndarray:
        """Return half the width (K,) of intervals that miss with at most the probability `level`, () or (K,).

        Each side, seeds and groups, has Student's quantile of its own degrees of freedom, and the squares add
        (Banerjee 1960). So three seeds that happen to agree don't count as many, as they would with
        Satterthwaite's degrees of freedom. The noise is in both sides; it counts once, with the larger
        quantile, and the result is no less than either side alone.

        Effects of groups may be skewed, noise is not. A value of B that is no larger than E may be noise,
        or a few skewed values that happen to be alike; the smaller the level, the more this matters. So the
        smaller quantile of noise is used for a part of B alone, which simulations showed to be safe: at most
        TRUST x level x E, never more than E, and none with two groups.
        """
        level = np.asarray(level)
        a, b, e = self.variances
        seeds, groups, heavy = (
            _squared(df, level) for df in (self.seeds, self.groups, reduce_freedom(self.groups))
        )
        light = np.minimum(b, np.minimum(1, TRUST * level) * e) if self.groups > 1 else 0.0
        a, b = seeds * a, groups * light + heavy * (b - light)
        return np.sqrt(np.maximum(np.maximum(a, b), a + b - np.minimum(seeds, groups) * e))

    def level(self, distance: np.ndarray) -> np.ndarray:
        """Return the level (K,) at which `half` is this distance (K,); 1 for distances of 0 and below.

        It is NaN if the distance or the variances are not finite: the missing error of a network that
        diverged is no evidence.
        """
        from scipy.optimize.elementwise import find_root  # slow to import

        # There is no closed form, so the level is found between two bounds. An interval from the wider side
        # alone, with the smaller quantile, is too narrow; one of sqrt(2) of its width, with the larger
        # quantile, is too wide. Where the first bound is not the level itself, a root is sought between them.
        levels = np.where(distance > 0, self._wider(distance, self.groups), 1.0)
        most = self._wider(distance / 1.42, reduce_freedom(self.groups))
        unsure = np.flatnonzero((distance > 0) & (levels > 0))
        args = (distance[unsure], *self.variances[:, unsure])
        wider = self._excess(np.log(levels[unsure]), *args) > 1e-9
        if wider.any():
            unsure, args = unsure[wider], tuple(part[wider] for part in args)
            bracket = np.log(levels[unsure]), np.log(most[unsure])
            levels[unsure] = np.exp(find_root(self._excess, bracket, args=args).x)
        return np.where(np.isfinite(distance + self.variances.sum(0)), levels, np.nan)

    def _wider(self, distance: np.ndarray, groups: float) -> np.ndarray:
        """Return the larger of the p-values (K,) that the two sides give separately."""
        sides = self.variances[:2]
        t = np.divide(distance, np.sqrt(sides), out=np.full(sides.shape, np.inf), where=sides > 0)
        return np.maximum(2 * stdtr(self.seeds, -t[0]), 2 * stdtr(groups, -t[1]))

    def _excess(self, log_level: np.ndarray, distance: np.ndarray, *variances: np.ndarray) -> np.ndarray:
        half = Error(np.stack(variances), self.seeds, self.groups).half(np.exp(log_level))
        return (half / distance) ** 2 - 1


def _squared(freedom: float, level: np.ndarray) -> np.ndarray:
    return stdtrit(freedom, level / 2) ** 2


def reduce_freedom(freedom: float) -> float:
    """Return the degrees of freedom at which Student's t has the tails of t statistics of skewed values.

    The mean of a few skewed values that all happen to be small looks more certain than it is. For 2 to 536
    exponential values, at levels from 0.05 to 0.0005, the degrees of freedom were measured to be 0.9 m^0.6 or
    a few more, with m = n - 1 (docs/statistics.md). Clips may be skewed like that. The effect of a seed is a
    sum of many small effects, and is taken as normal.

    Args:
        freedom: m, the degrees of freedom of normal values.
    """
    return min(freedom, 0.9 * freedom**0.6)


def estimate_error(differences: np.ndarray, groups: Groups = None) -> Error:
    """Return the error of the means of differences (K, S, C) over seeds and clips."""
    means, weights = average_groups(differences, groups)
    _, s, g = means.shape
    none = np.zeros(len(means))
    a = (means @ weights).var(1, ddof=1) / s if s > 1 else none
    b = means.mean(1).var(1, ddof=1) * (weights @ weights) if g > 1 else none
    e = estimate_noise(means, weights) if s > 1 and g > 1 else none
    single = " and ".join(name for name, number in (("seeds", s), ("clips", g)) if number == 1)
    return Error(np.stack([a, b, e]), max(s - 1, 1), max(g - 1, 1), single)


def average_groups(differences: np.ndarray, groups: Groups = None) -> tuple[np.ndarray, np.ndarray]:
    """Average differences (K, S, C) over the clips of each group.

    Returns:
        The groups' means (K, S, G), and each group's share of the clips (G,).
    """
    clips = differences.shape[2]
    if groups is None:
        return differences, np.full(clips, 1 / clips)
    _, index, sizes = np.unique(np.asarray(groups), return_inverse=True, return_counts=True)
    starts = np.cumsum(sizes) - sizes
    sums = np.add.reduceat(differences[:, :, np.argsort(index, kind="stable")], starts, axis=2)
    return sums / sizes, sizes / clips


def estimate_noise(means: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the variance E (K,) of the groups' means (K, S, G), whose weights are (G,)."""
    seeds = means.shape[1]
    rest = means - means.mean(1, keepdims=True)
    return rest.var(2, ddof=1).sum(1) * (weights @ weights) / (seeds * (seeds - 1))


class EffectEstimates(NamedTuple):
    """The effects of K comparisons.

    Attributes:
        mean: the mean difference (K,).
        low, high: the ends of its 95 % interval (K,); NaN if undefined.
        p: its p-value (K,); NaN if undefined.
        conditional: what there is only one of, so that interval and mean don't cover others: "seeds", "clips"
            (one group of them), "seeds and clips", or "" if there are several of both. Unless it is "", there
            are no p-values.
    """

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    p: np.ndarray
    conditional: str


def estimate_paired_effects(differences: np.ndarray, groups: Groups = None) -> EffectEstimates:
    """Return the effects of differences (K, S, C) over seeds and clips, whose groups are `groups` (C,).

    Interval and p-value agree: 0 is outside the interval exactly if p is below 0.05.
    """
    mean, known = differences.mean((1, 2)), estimate_error(differences, groups)
    nothing = np.full_like(mean, np.nan)
    half = nothing if known.conditional == "seeds and clips" else known.half(LEVEL)
    p = nothing if known.conditional else known.level(np.abs(mean))
    return EffectEstimates(mean, mean - half, mean + half, p, known.conditional)


def estimate_seed_effects(differences: np.ndarray) -> EffectEstimates:
    """Return the effects of differences (K, S) in something that each seed has once, such as a time."""
    alone = differences[:, :, None]
    effects, several = estimate_paired_effects(alone), differences.shape[1] > 1
    p = estimate_error(alone).level(np.abs(effects.mean)) if several else effects.p
    return effects._replace(p=p, conditional="" if several else "seeds")


def compute_equivalence_p(
    differences: np.ndarray, margin: float | np.ndarray, groups: Groups = None
) -> np.ndarray:
    """Return the p-values (K,) of the claim that means of differences (K, S, C) lie within +-margin.

    The margin is () or (K,), in the unit of the differences. A p-value is the level at which the interval
    just lies within the margin. Two one-sided tests would use the interval of twice that level (Schuirmann
    1987). So this test is on the safe side, and it agrees with the interval that is shown. The p-values are
    NaN with one seed or one group.
    """
    known = estimate_error(differences, groups)
    if known.conditional:
        return np.full(len(differences), np.nan)
    return known.level(margin - np.abs(differences.mean((1, 2))))


def compute_detectable(
    differences: np.ndarray, comparisons: int, groups: Groups = None, power: float = 0.8
) -> np.ndarray:
    """Return the effects (K,) that tables like these differences (K, S, C) would find with this power.

    "Find" means to call significant at the first, strictest step of Holm's correction over `comparisons`. The
    measured variances are taken as the true ones, and all effects as normal. The result is NaN with one seed
    or one group.
    """
    known = estimate_error(differences, groups)
    if known.conditional:
        return np.full(len(differences), np.nan)
    return find_effects(known.parts, differences.shape[1], known.groups, LEVEL / comparisons, power)


def count_needed_seeds(
    differences: np.ndarray, effect: float, comparisons: int, groups: Groups = None, most: int = 1000
) -> int | None:
    """Return the fewest seeds with which an effect would be found with a power of 80 %.

    It is computed as in `compute_detectable`, with the parts of seeds and noise divided by the seeds.

    Args:
        differences: the differences of one comparison (S, C).
        effect: the effect to be found, in the unit of the differences.
        comparisons: how many comparisons Holm's correction is over.
        groups: the group of each clip (C,).
        most: the largest number of seeds to consider.

    Returns:
        The number; None if `most` seeds are not enough, and with one seed or one group.
    """
    known = estimate_error(differences[None], groups)
    if known.conditional:
        return None

    def is_enough(seeds: int) -> bool:
        share = len(differences) / seeds
        parts = known.parts * [[share], [1], [share]]
        return bool(find_effects(parts, seeds, known.groups, LEVEL / comparisons, 0.8)[0] <= abs(effect))

    return bisect.bisect_left(range(most), True, lo=2, key=is_enough) if is_enough(most) else None


def find_effects(parts: np.ndarray, seeds: int, groups: float, level: float, power: float) -> np.ndarray:
    """Return the effects (K,) that are found at this level with this power.

    An effect is found if it exceeds half the width of the interval minus the error of the mean. So the result
    is a quantile of that difference over simulated tables.

    Args:
        parts: the true parts (3, K) of seeds, groups and noise in the variance of the mean.
        seeds: the number of seeds.
        groups: degrees of freedom of B.
        level: the level of the test.
        power: the share of tables in which the effect is to be found.
    """
    z, estimates = _draws(seeds, groups)
    true = parts + parts[2] * [[1], [1], [0]]  # the estimates A and B both contain the noise
    drawn = (true[:, :, None] * estimates[:, None]).reshape(3, -1)
    half = Error(drawn, seeds - 1, groups).half(level).reshape(-1, DRAWS)
    return np.quantile(half - np.sqrt(parts.sum(0))[:, None] * z, power, axis=1)


@functools.cache
def _draws(seeds: int, groups: float) -> tuple[np.ndarray, np.ndarray]:
    """Draw the random quantities that vary between tables.

    Returns:
        Standard normal errors of the mean (DRAWS,), and estimates of A, B and E divided by their expectations
        (3, DRAWS), which are chi-squared over their degrees of freedom.
    """
    from scipy.stats import qmc  # slow to import, as is all of scipy.stats

    uniform = qmc.Sobol(4, seed=0).random(DRAWS).T
    freedoms = np.array([[seeds - 1], [groups], [(seeds - 1) * groups]])
    return ndtri(uniform[0]), chdtri(freedoms, uniform[1:]) / freedoms


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


def correct_by_holm(p: np.ndarray) -> np.ndarray:
    """Correct p-values (K,) for their number by Holm's step-down method; NaN stays NaN and does not count.

    The probability of any wrong claim of a difference stays below the level (Holm 1979).
    """
    p = np.asarray(p, float)
    order = np.flatnonzero(~np.isnan(p))
    order = order[np.argsort(p[order])]
    corrected = np.full_like(p, np.nan)
    corrected[order] = np.minimum(1, np.maximum.accumulate(p[order] * np.arange(len(order), 0, -1)))
    return corrected


def decide(
    difference: float, equivalence: float, mean: float, paper: float | None = None, level: float = LEVEL
) -> Verdict:
    """Return the verdict on one comparison of a table.

    Claims of a difference and claims of equivalence are two families, each with 5 % for a wrong claim: they
    answer different questions, and a mean can't be wrongly called both. An interval within the margin shows
    that there is no effect of interest, even if it does not contain 0.

    Args:
        difference: the p-value of a difference, corrected over the table; NaN if undefined.
        equivalence: the p-value of `compute_equivalence_p`, corrected in the same way.
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


def make_schedule(most: int) -> tuple[int, ...]:
    """Return the numbers of seeds of the interim analyses: 3, 5, 8, 13, ... up to `most`.

    Two seeds never decide anything at the levels of a table, so the first one is at three.
    """
    counts = [3, 5]
    while counts[-1] < most:
        counts.append(counts[-1] + counts[-2])
    return (*itertools.takewhile(lambda count: count < most, counts), most)


def divide_level(number: int) -> tuple[float, ...]:
    """Return the level that each of `number` interim analyses may spend.

    Together they are 5 %, so that nothing need be assumed about how the analyses depend on each other. Each
    level is twice the one before: among weights growing by a factor of 1, 2 or 3, these lose few decisions
    and cost few seeds.
    """
    weights = 2.0 ** np.arange(number)
    return tuple(map(float, LEVEL * weights / weights.sum()))


def correct_sequentially(p: np.ndarray, claimed: np.ndarray, closed: np.ndarray) -> np.ndarray:
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
    return correct_by_holm(np.where(claimed, 0.0, np.where(closed, 1.0, p)))
