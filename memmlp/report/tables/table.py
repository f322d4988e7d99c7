"""The content of a table: rows of variants, cells of metrics, effects with verdicts."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from memmlp.report.tables.statistics import Verdict
from memmlp.sweep.definition import COSTS

LEVEL = 0.05
STEADY = 1.25  # how many times a measured time may be another of the same work


class Key(NamedTuple):
    """The key of a table's cell: its variant, mode of evaluation and metric."""

    label: str
    mode: str
    metric: str


@dataclass(frozen=True)
class Effect:
    """A variant's difference from its control, over the seeds and clips that both have.

    Fields that a comparison does not have are None; costs have only the mean, and whether it is noise.

    Attributes:
        mean: the mean difference.
        low, high: its 95 % interval.
        p: its p-value, not corrected.
        holm: its p-value, corrected over the table's comparisons.
        equal: the corrected p-value of equivalence (see `memmlp.report.tables.statistics`).
        verdict: the verdict that follows from these.
        detectable: the smallest difference that this comparison would have found with 80 % power.
        seeds, clips, groups: how many of each were paired.
        level: the level with which the corrected p-values are compared.
        decided: the number of seeds of the interim analysis that decided the verdict; None without one.
        within_noise: whether it is between times that differ by no more than STEADY times.
    """

    mean: float
    low: float | None = None
    high: float | None = None
    p: float | None = None
    holm: float | None = None
    equal: float | None = None
    verdict: Verdict | None = None
    detectable: float | None = None
    seeds: int = 0
    clips: int = 0
    groups: int = 0
    level: float = LEVEL
    decided: int | None = None
    within_noise: bool = False

    @property
    def significant(self) -> bool:
        """Whether the difference is significant after the correction."""
        return self.holm is not None and self.holm < self.level


@dataclass(frozen=True)
class Cell:
    """A metric of a variant: its values by seed, the paper's value, and both differences from the control."""

    values: Mapping[int, float]
    paper: float | None = None
    effect: Effect | None = None
    paper_effect: float | None = None

    @property
    def mean(self) -> float | None:
        """The mean over seeds."""
        return math.fsum(self.values.values()) / len(self.values) if self.values else None

    @property
    def sd(self) -> float | None:
        """The standard deviation over seeds (n - 1); None with fewer than two."""
        if self.mean is None or len(self.values) < 2:
            return None
        squares = math.fsum((value - self.mean) ** 2 for value in self.values.values())
        return math.sqrt(squares / (len(self.values) - 1))

    @property
    def agrees(self) -> bool | None:
        """True if the paper's effect holds, False if its opposite does; None if neither is known.

        The verdict decides; for a cost, which has no verdict, the sign does, beyond the noise of times.
        """
        if self.effect is None or not self.paper_effect or not self.effect.mean or self.effect.within_noise:
            return None
        if not self.effect.seeds:
            return (self.effect.mean > 0) == (self.paper_effect > 0)
        return {Verdict.HOLDS: True, Verdict.OPPOSITE: False}.get(self.effect.verdict or Verdict.INCONCLUSIVE)


@dataclass(frozen=True)
class Row:
    """A variant of a table.

    Attributes:
        label: the variant's label.
        branch: whose errors are shown.
        against: the label of its control; None for the sweep's control and for rows with only the paper's
            values.
        note: a remark; None for none.
        found: the seeds of its finished runs.
        wanted: the seeds that it should have; empty for a row with only the paper's values.
        cells: its cells by mode and metric.
        pairing: in words, which variant is its control in every cell of the axes; empty if it has a single
            control.
    """

    label: str
    branch: str
    against: str | None
    note: str | None
    found: tuple[int, ...]
    wanted: tuple[int, ...]
    cells: Mapping[str, Mapping[str, Cell]]
    pairing: str = ""

    @property
    def paper_only(self) -> bool:
        """Whether nothing is measured for this row."""
        return not self.wanted


@dataclass(frozen=True)
class Table:
    """A sweep's variants side by side.

    Attributes:
        name: the sweep's name.
        title: the sweep's title.
        number: the table's number in the paper; None if it is not the paper's.
        modes: the modes of evaluation; a single one if only costs are shown.
        metrics: the columns.
        control: the label of the variant with which variants are compared that name no other control.
        branch_source: how we know which branch the paper's values belong to; None if it prints none.
        smallest: the smallest effect of interest by metric.
        comparisons: the number of p-values in the correction.
        rows: the variants.
        notes: remarks on the paper's values.
        flags: what a reader has to know about these runs.
        analyses: the number of seeds and the level of each interim analysis; empty for a fixed number of
            seeds.
    """

    name: str
    title: str
    number: int | None
    modes: tuple[str, ...]
    metrics: tuple[str, ...]
    control: str
    branch_source: str | None
    smallest: Mapping[str, float]
    comparisons: int
    rows: tuple[Row, ...]
    notes: tuple[str, ...]
    flags: tuple[str, ...]
    analyses: tuple[tuple[int, float], ...] = ()

    @property
    def measured_metrics(self) -> tuple[str, ...]:
        """The columns that are errors, not costs."""
        return tuple(metric for metric in self.metrics if metric not in COSTS)

    def effects(self, mode: str) -> Iterator[tuple[Row, str, Cell, Effect]]:
        """Yield the effects of a mode that have a verdict, with their rows, metrics and cells."""
        for row in self.rows:
            for metric, cell in row.cells[mode].items():
                if cell.effect is not None and cell.effect.verdict is not None:
                    yield row, metric, cell, cell.effect

    def verdicts(self, mode: str) -> Counter[Verdict]:
        """Count, by verdict, the effects of a mode for which the paper prints one, too."""
        found = (effect.verdict for _, _, cell, effect in self.effects(mode) if cell.paper_effect)
        return Counter(verdict for verdict in found if verdict is not None)

    def detectable(self, mode: str, metric: str) -> float | None:
        """Return the smallest difference that every comparison would have found with 80 % power.

        Comparisons that could not have found anything, such as those with one seed, are left out (`blind`).
        """
        known = [effect.detectable for _, name, _, effect in self.effects(mode) if name == metric]
        return max((one for one in known if one is not None), default=None)

    def blind(self, mode: str, metric: str) -> list[str]:
        """Return the labels of the variants whose comparison could not have found any difference."""
        found = [(row.label, row.cells[mode][metric].effect) for row in self.rows]
        return [label for label, effect in found if effect is not None and effect.detectable is None]
