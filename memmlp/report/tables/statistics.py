"""Statistics of differences between two variants with the same seeds and the same test clips.

`differences` have the shape (K, S, C): for K comparisons, the variant's error minus the control's error, for
seed s on clip c. The order below is: intervals and p-values, detectable effects, verdicts.
docs/statistics.md explains the method and its error rates.

Seeds and groups of clips are crossed: every seed saw every clip. The model is d[s, c] = mean + effect of seed
s + effect of c's group + effect of clip c + noise, with unknown variances. Clips are first averaged within
groups (takes, subjects), because groups are the replicates. A group has the weight w[g], its fraction of the
clips, so the mean is still the mean over clips. The group means m[s, g] give three variances, with these
degrees of freedom:

    A = variance of the S seed means / S                                      S - 1
    B = variance of the G group means x sum of w^2                            G - 1
    E = variance of the residuals x sum of w^2 / S                            (S - 1) (G - 1)

A + B - E estimates the variance of the mean, because both A and B contain the noise. If groups differ in
size, B is biased: too large if clips differ more than groups, too small if larger groups have larger effects.
"""

import bisect
import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, gammaincinv, ndtri, stdtr, stdtrit

LEVEL = 0.05
DRAWS = 4096  # number of simulated tables; Sobol's sequence needs a power of two
RESAMPLES = 1 << 16  # number of simulated comparisons of a bootstrap p-value
FEW_GROUPS = 30  # maximum number of clip groups for a bootstrap p-value

Groups = np.ndarray | Sequence[object] | None
"""The group of each clip (C,), as integers or labels; None if each clip forms a separate group."""

MAX_UNSKEWED_NOISE = 5.0
"""At most MAX_UNSKEWED_NOISE x level x E of B counts as noise without skew.

The value comes from simulations; see `Error.compute_half_width` and docs/statistics.md.
"""


@dataclass(frozen=True)
class Error:
    """The estimated errors of K means.

    Args:
        variances: A, B and E from the module's docstring, (3, K). A and E are 0 with a single seed, B and E
            with a single group.
        seeds: degrees of freedom of A.
        groups: degrees of freedom of B.
        single: the number of factors with a single level, which the error does not cover: seeds, groups.
    """

    variances: np.ndarray
    seeds: float
    groups: float
    single: int = 0

    @property
    def variance_parts(self) -> np.ndarray:
        """The variances (3, K) of the means due to seeds, groups and noise."""
        seeds, clips, noise = self.variances
        return np.stack([np.maximum(seeds - noise, 0), np.maximum(clips - noise, 0), noise])

    def compute_half_width(self, level: float | np.ndarray) -> np.ndarray:
        """Return half the width (K,) of intervals with an error probability of at most `level`, () or (K,).

        Seeds and groups are two sides. Each side has Student's quantile for its degrees of freedom, and the
        squares add (Banerjee 1960). With Satterthwaite's degrees of freedom, three seeds that agree by chance
        would count as many seeds. Both sides contain the noise; it counts once, with the larger quantile. The
        result is at least as large as each side.

        Group effects may be skewed, but noise is not. If B is at most E, it may be noise, or a few skewed
        values that are similar by chance. This matters more at small levels. So the smaller quantile of noise
        applies only to a part of B, which was safe in simulations: at most MAX_UNSKEWED_NOISE x level x E,
        at most E, and 0 with two groups.
        """
        level = np.asarray(level)
        a, b, e = self.variances
        seeds, groups, heavy = (
            _square_quantile(df, level) for df in (self.seeds, self.groups, reduce_freedom(self.groups))
        )
        light = np.minimum(b, np.minimum(1, MAX_UNSKEWED_NOISE * level) * e) if self.groups > 1 else 0.0
        a, b = seeds * a, groups * light + heavy * (b - light)
        return np.sqrt(np.maximum(np.maximum(a, b), a + b - np.minimum(seeds, groups) * e))

    def compute_significance_level(self, distance: np.ndarray) -> np.ndarray:
        """Return the error probability (K,) at which intervals have this half width (K,).

        It is 1 for half widths of 0 and below. It is NaN with a single seed or group, and if `distance` or a
        variance is not finite, because a diverged network is not evidence.
        """
        if self.single:
            return np.full(len(distance), np.nan)
        from scipy.optimize.elementwise import find_root  # slow to import

        # There is no closed form, so a root is searched between two bounds. The interval of the wider side
        # with the smaller quantile is too narrow. The sqrt(2) times wider interval with the larger quantile
        # is too wide. No search is needed if the first bound is the level.
        levels = np.where(distance > 0, self._compute_larger_p(distance, self.groups), 1.0)
        most = self._compute_larger_p(distance / 1.42, reduce_freedom(self.groups))
        unsure = np.flatnonzero((distance > 0) & (levels > 0))
        args = (distance[unsure], *self.variances[:, unsure])
        wider = self._compute_excess(np.log(levels[unsure]), *args) > 1e-9
        if wider.any():
            unsure, args = unsure[wider], tuple(part[wider] for part in args)
            bracket = np.log(levels[unsure]), np.log(most[unsure])
            levels[unsure] = np.exp(find_root(self._compute_excess, bracket, args=args).x)
        return np.where(np.isfinite(distance + self.variances.sum(0)), levels, np.nan)

    def _compute_larger_p(self, distance: np.ndarray, groups: float) -> np.ndarray:
        """Return the larger p-value (K,) of the two sides, seeds and groups."""
        sides = self.variances[:2]
        t = np.divide(distance, np.sqrt(sides), out=np.full(sides.shape, np.inf), where=sides > 0)
        return np.maximum(2 * stdtr(self.seeds, -t[0]), 2 * stdtr(groups, -t[1]))

    def _compute_excess(
        self, log_level: np.ndarray, distance: np.ndarray, *variances: np.ndarray
    ) -> np.ndarray:
        half = Error(np.stack(variances), self.seeds, self.groups).compute_half_width(np.exp(log_level))
        return (half / distance) ** 2 - 1


def _square_quantile(freedom: float, level: np.ndarray) -> np.ndarray:
    return stdtrit(freedom, level / 2) ** 2


def reduce_freedom(freedom: float) -> float:
    """Return degrees of freedom that give Student's t the tails of t statistics of skewed values.

    The standard error of a few skewed values that are all small by chance is too small. For 2 to 536
    exponential values, at levels from 0.05 to 0.0005, simulations gave 0.9 m^0.6 degrees of freedom or a few
    more, with m = n - 1 (docs/statistics.md). Clips may have such a skew. Seed effects are assumed to be
    normal, because they are sums of many small effects.

    Args:
        freedom: m, the degrees of freedom for normal values.
    """
    return min(freedom, 0.9 * freedom**0.6)


def estimate_error(differences: np.ndarray, groups: Groups = None) -> Error:
    """Estimate the errors of mean differences. `differences` are (K, S, C)."""
    means, weights = average_groups(differences, groups)
    _, s, g = means.shape
    none = np.zeros(len(means))
    a = (means @ weights).var(1, ddof=1) / s if s > 1 else none
    b = means.mean(1).var(1, ddof=1) * (weights @ weights) if g > 1 else none
    e = estimate_noise(means, weights) if s > 1 and g > 1 else none
    return Error(np.stack([a, b, e]), max(s - 1, 1), max(g - 1, 1), (s == 1) + (g == 1))


def average_groups(differences: np.ndarray, groups: Groups = None) -> tuple[np.ndarray, np.ndarray]:
    """Average differences (K, S, C) over the clips of each group.

    Returns:
        The group means (K, S, G), and each group's fraction of the clips (G,).
    """
    clips = differences.shape[2]
    if groups is None:
        return differences, np.full(clips, 1 / clips)
    _, index, sizes = np.unique(np.asarray(groups), return_inverse=True, return_counts=True)
    starts = np.cumsum(sizes) - sizes
    sums = np.add.reduceat(differences[:, :, np.argsort(index, kind="stable")], starts, axis=2)
    return sums / sizes, sizes / clips


def estimate_noise(means: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the variance E (K,), from group means (K, S, G) and their weights (G,)."""
    seeds = means.shape[1]
    rest = means - means.mean(1, keepdims=True)
    return rest.var(2, ddof=1).sum(1) * (weights @ weights) / (seeds * (seeds - 1))


class EffectEstimates(NamedTuple):
    """The effects of K comparisons.

    Attributes:
        mean: the mean difference (K,).
        low, high: the limits of the 95 % interval (K,); NaN if undefined.
        p: the p-value (K,); NaN if undefined, also with a single seed or group, which the interval does not
            cover.
    """

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    p: np.ndarray


def estimate_paired_effects(differences: np.ndarray, groups: Groups = None) -> EffectEstimates:
    """Return effects with intervals and p-values, from differences (K, S, C) and groups (C,).

    Interval and p-value agree: the interval excludes 0 exactly if p < 0.05.
    """
    mean, known = differences.mean((1, 2)), estimate_error(differences, groups)
    p = known.compute_significance_level(np.abs(mean))
    return EffectEstimates(mean, *estimate_interval(differences, groups), p)


def compute_bootstrap_p(differences: np.ndarray, groups: Groups = None) -> np.ndarray:
    """Return p-values (K,) by a parametric bootstrap, from differences (K, S, C) and groups (C,).

    The interval must be safe for any ratio of seed effects and group effects, so its p-values are often
    larger than needed. The bootstrap p-value is the probability of a p-value this small without an effect, if
    A and B are the true variances: the larger one for normal and for exponential group effects. Few seeds may
    understate A, so its upper confidence limit counts, too, with an error probability of p. A and B both
    contain the noise, which therefore counts twice. P-values are NaN with a single seed, with a single group
    or with more than FEW_GROUPS groups.
    """
    known, (_, weights) = estimate_error(differences, groups), average_groups(differences[:1], groups)
    if known.single or len(weights) > FEW_GROUPS:
        return np.full(len(differences), np.nan)
    levels = known.compute_significance_level(np.abs(differences.mean((1, 2))))
    seed_means, seed_variances, effects = _draw_effects(int(known.seeds) + 1, tuple(weights))
    found = np.full(len(differences), np.nan)
    for k in np.flatnonzero(np.isfinite(levels)):
        a, b, _ = known.variances[:, k]
        light = _square_quantile(known.seeds, levels[k]) * seed_variances
        heavy = _square_quantile(reduce_freedom(known.groups), levels[k])
        limit = known.seeds / (2 * gammaincinv(known.seeds / 2, max(levels[k], 1e-12)))
        counts = [
            np.sum((np.sqrt(c) * seed_means + np.sqrt(b) * means) ** 2 >= c * light + b * heavy * variances)
            for c in (a, a * max(limit, 1))
            for means, variances in effects
        ]
        found[k] = (max(counts) + 1) / (RESAMPLES + 1)
    return found


@functools.cache
def _draw_effects(
    seeds: int, weights: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    """Draw seed effects and group effects that give a mean the variance 1.

    Returns:
        The means of the seed effects and the estimates of their variance, (RESAMPLES,) each; the same of
        group effects, normal and exponential.
    """
    rng, share, size = np.random.default_rng(0), np.array(weights), (RESAMPLES, len(weights))
    scale = np.sqrt(share @ share)
    effects = [rng.normal(size=size), rng.exponential(size=size) - 1]
    means, variances = rng.normal(size=RESAMPLES), rng.chisquare(seeds - 1, RESAMPLES) / (seeds - 1)
    return means, variances, [(one @ share / scale, one.var(1, ddof=1)) for one in effects]


def estimate_interval(values: np.ndarray, groups: Groups = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the limits (K,) of the 95 % intervals of means, from values (K, S, C) and groups (C,).

    They are NaN with a single seed and a single group.
    """
    mean, known = values.mean((1, 2)), estimate_error(values, groups)
    half = np.full_like(mean, np.nan) if known.single == 2 else known.compute_half_width(LEVEL)
    return mean - half, mean + half


def compute_equivalence_p(
    differences: np.ndarray, margin: float | np.ndarray, groups: Groups = None
) -> np.ndarray:
    """Return p-values (K,) of equivalence: the means of differences (K, S, C) are within +-margin.

    The margin, () or (K,), has the unit of the differences. The p-value is the smallest level with an
    interval inside the margin. Two one-sided tests allow twice this level for the same interval (Schuirmann
    1987), so this test is conservative. It agrees with the shown interval. P-values are NaN with a single
    seed or group.
    """
    known = estimate_error(differences, groups)
    return known.compute_significance_level(margin - np.abs(differences.mean((1, 2))))


def compute_detectable(
    differences: np.ndarray, comparisons: int, groups: Groups = None, power: float = 0.8
) -> np.ndarray:
    """Return the smallest effects (K,) that are detectable with this power, given differences (K, S, C).

    An effect is detected if it is significant at the first, strictest step of Holm's correction for
    `comparisons`. Measured variances count as true variances, and all effects as normal. The result is NaN
    with a single seed or group.
    """
    known = estimate_error(differences, groups)
    if known.single:
        return np.full(len(differences), np.nan)
    return find_detectable_effects(
        known.variance_parts, differences.shape[1], known.groups, LEVEL / comparisons, power
    )


def count_needed_seeds(
    differences: np.ndarray, effect: float, comparisons: int, groups: Groups = None, max_seeds: int = 1000
) -> int | None:
    """Return the smallest number of seeds that detects an effect with a power of 80 %.

    The method is that of `compute_detectable`; the variances due to seeds and noise scale with 1 / seeds.

    Args:
        differences: the differences of one comparison (S, C).
        effect: the effect to detect, in the unit of the differences.
        comparisons: the number of comparisons in Holm's correction.
        groups: the group of each clip (C,).
        max_seeds: the maximum number of seeds.

    Returns:
        The number; None if `max_seeds` seeds are too few, or `differences` have a single seed or group.
    """
    known = estimate_error(differences[None], groups)
    if known.single:
        return None

    def is_enough(seeds: int) -> bool:
        share = len(differences) / seeds
        parts = known.variance_parts * [[share], [1], [share]]
        return bool(
            find_detectable_effects(parts, seeds, known.groups, LEVEL / comparisons, 0.8)[0] <= abs(effect)
        )

    return bisect.bisect_left(range(max_seeds), True, lo=2, key=is_enough) if is_enough(max_seeds) else None


def find_detectable_effects(
    parts: np.ndarray, seeds: int, groups: float, level: float, power: float
) -> np.ndarray:
    """Return the smallest effects (K,) that are detectable at this level with this power.

    A table detects an effect if it exceeds the interval's half width minus the error of the mean. So the
    result is a quantile of this difference over simulated tables.

    Args:
        parts: the true variances (3, K) of the mean due to seeds, groups and noise.
        seeds: the number of seeds.
        groups: degrees of freedom of B.
        level: the level of the test.
        power: the fraction of tables that should detect the effect.
    """
    z, estimates = _draw_tables(seeds, groups)
    expected = parts + parts[2] * [[1], [1], [0]]  # A and B both contain the noise
    drawn = (expected[:, :, None] * estimates[:, None]).reshape(3, -1)
    half = Error(drawn, seeds - 1, groups).compute_half_width(level).reshape(-1, DRAWS)
    return np.quantile(half - np.sqrt(parts.sum(0))[:, None] * z, power, axis=1)


@functools.cache
def _draw_tables(seeds: int, groups: float) -> tuple[np.ndarray, np.ndarray]:
    """Draw the random quantities of simulated tables.

    Returns:
        Standard normal errors of the mean (DRAWS,), and A, B and E divided by their expectations (3, DRAWS),
        which are chi-squared values divided by degrees of freedom.
    """
    from scipy.stats import qmc  # slow to import

    uniform = qmc.Sobol(4, seed=0).random(DRAWS).T
    freedoms = np.array([[seeds - 1], [groups], [(seeds - 1) * groups]])
    return ndtri(uniform[0]), chdtri(freedoms, uniform[1:]) / freedoms


class Verdict(StrEnum):
    """The claim about a comparison.

    HOLDS and OPPOSITE refer to the paper's effect. HIGHER and LOWER describe the measured difference if the
    paper has no effect. INCONCLUSIVE makes no claim.
    """

    HOLDS = "holds"
    OPPOSITE = "opposite"
    HIGHER = "higher"
    LOWER = "lower"
    EQUIVALENT = "equivalent"
    INCONCLUSIVE = "inconclusive"


def correct_by_holm(p: np.ndarray) -> np.ndarray:
    """Correct p-values (K,) by Holm's step-down method; NaN stays NaN and does not count.

    The probability of at least one wrong claim stays below the level (Holm 1979).
    """
    p = np.asarray(p, float)
    order = np.flatnonzero(~np.isnan(p))
    order = order[np.argsort(p[order])]
    corrected = np.full_like(p, np.nan)
    corrected[order] = np.minimum(1, np.maximum.accumulate(p[order] * np.arange(len(order), 0, -1)))
    return corrected


def decide_verdict(
    difference: float, equivalence: float, mean: float, paper: float | None = None, level: float = LEVEL
) -> Verdict:
    """Return the verdict on one comparison of a table.

    Claims of a difference and claims of equivalence are two families, each with an error probability of 5 %.
    They answer different questions, and a mean cannot be wrong in both families. Equivalence comes first: an
    interval inside the margin shows that no effect of interest exists, even if it excludes 0.

    Args:
        difference: the p-value of a difference, corrected for the whole table; NaN if undefined.
        equivalence: the p-value from `compute_equivalence_p`, corrected for the whole table.
        mean: the measured mean difference.
        paper: the paper's difference; None or 0 if the paper claims no sign.
        level: the level of each family; below 5 % for an interim analysis.
    """
    if equivalence <= level:
        return Verdict.EQUIVALENT
    if not difference <= level:
        return Verdict.INCONCLUSIVE
    if paper:
        return Verdict.HOLDS if mean * paper > 0 else Verdict.OPPOSITE
    return Verdict.HIGHER if mean > 0 else Verdict.LOWER


def make_schedule(max_seeds: int) -> tuple[int, ...]:
    """Return the numbers of seeds at the interim analyses: 3, 5, 8, 13, ... up to `max_seeds`.

    The first analysis needs three seeds, because two seeds decide nothing at the levels of a table.
    """
    counts = [3, 5]
    while counts[-1] < max_seeds:
        counts.append(counts[-1] + counts[-2])
    return (*itertools.takewhile(lambda count: count < max_seeds, counts), max_seeds)


def divide_level(analysis_count: int) -> tuple[float, ...]:
    """Divide the level of 5 % between interim analyses.

    The sum is 5 %, so the analyses may depend on each other in any way. Each level is twice the previous
    level. Compared with factors 1 and 3, a factor of 2 loses few decisions and needs few seeds.
    """
    weights = 2.0 ** np.arange(analysis_count)
    return tuple(map(float, LEVEL * weights / weights.sum()))


def correct_sequentially(p: np.ndarray, claimed: np.ndarray, closed: np.ndarray) -> np.ndarray:
    """Correct p-values (K,) by Holm's method at an interim analysis, for comparison with its level.

    Decisions are final. Earlier claims of this family no longer count in the correction. Comparisons that
    were closed without such a claim still count, but can no longer be claimed. They are closed if the other
    family decided them, or if their variant left the rounds.

    A first wrong claim needs a true null hypothesis with a p-value below the analysis' level divided by the
    number of null hypotheses. The analyses are fixed in advance, so the levels add up.

    Args:
        p: p-values (K,) at this analysis; NaN if undefined, which decides nothing.
        claimed: comparisons with earlier claims of this family, (K,) bool.
        closed: comparisons that were closed without such a claim, (K,) bool.
    """
    return correct_by_holm(np.where(claimed, 0.0, np.where(closed, 1.0, p)))
