"""What a table holds: rows of arms, cells of metrics, effects with verdicts."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from memmlp.statistics import Verdict
from memmlp.sweep.spec import COSTS

LEVEL = 0.05


class Key(NamedTuple):
    """The place of a cell."""

    label: str
    mode: str
    metric: str


@dataclass(frozen=True)
class Effect:
    """An arm's difference from its control over the seeds and clips that both have.

    Attributes:
        mean, low, high: the difference and its 95 % interval. p, holm: p-value, alone and corrected over the
            table's comparisons; equal: the corrected p-value of equivalence (see `memmlp.statistics`).
        verdict: what follows from them. detectable: the smallest difference that this comparison would have
            called significant with 80 % power. All of these are None where there are none, as of costs.
        seeds, clips, groups: how many were paired.
        level: what the corrected p-values are compared with. decided: of a verdict that is final since a look
            at so many seeds, those.
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

    @property
    def significant(self) -> bool:
        """Whether it is significant at its level after the correction."""
        return self.holm is not None and self.holm < self.level


@dataclass(frozen=True)
class Cell:
    """A metric of an arm: the values by seed, the paper's value, and both differences from the control."""

    values: Mapping[int, float]
    paper: float | None = None
    effect: Effect | None = None
    paper_effect: float | None = None

    @property
    def mean(self) -> float | None:
        """Mean over seeds."""
        return math.fsum(self.values.values()) / len(self.values) if self.values else None

    @property
    def sd(self) -> float | None:
        """Standard deviation over seeds (n - 1); None under two."""
        if self.mean is None or len(self.values) < 2:
            return None
        squares = math.fsum((value - self.mean) ** 2 for value in self.values.values())
        return math.sqrt(squares / (len(self.values) - 1))

    @property
    def agrees(self) -> bool | None:
        """Whether the paper's effect holds (True) or its opposite (False); None where neither is known.

        Of an effect by its verdict; of a cost, which has none, by its sign.
        """
        if self.effect is None or not self.paper_effect or not self.effect.mean:
            return None
        if not self.effect.seeds:
            return (self.effect.mean > 0) == (self.paper_effect > 0)
        return {Verdict.HOLDS: True, Verdict.OPPOSITE: False}.get(self.effect.verdict or Verdict.OPEN)


@dataclass(frozen=True)
class Row:
    """An arm.

    Attributes:
        label, note: of the sweep's arm. branch: whose errors are shown. against: the label of its control,
            None for the sweep's control.
        found, wanted: seeds; none is wanted of a row that is the paper's alone.
        cells: by mode and metric.
    """

    label: str
    branch: str
    against: str | None
    note: str | None
    found: tuple[int, ...]
    wanted: tuple[int, ...]
    cells: Mapping[str, Mapping[str, Cell]]

    @property
    def paper_only(self) -> bool:
        """Whether nothing is measured for this row."""
        return not self.wanted


@dataclass(frozen=True)
class Table:
    """A sweep's arms side by side.

    Attributes:
        name, title, number: of the sweep; the number is that in the paper.
        modes: of evaluation; one where only costs are shown. metrics: the columns.
        control: label of the arm that the others are compared with, where they name no other.
        branch_source: how it is known which branch the paper's values are of; None where it prints none.
        smallest: the smallest effect of interest by metric.
        comparisons: how many p-values the correction is over.
        notes: about the paper's values. flags: what a reader has to know of these runs.
        looks: at how many seeds and which levels verdicts were decided; none at a fixed number of seeds.
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
    looks: tuple[tuple[int, float], ...] = ()

    @property
    def measured_metrics(self) -> tuple[str, ...]:
        """The columns that are errors and no costs."""
        return tuple(metric for metric in self.metrics if metric not in COSTS)

    def effects(self, mode: str) -> Iterator[tuple[Row, str, Cell, Effect]]:
        """The cells of a mode whose effects have a verdict, with their row and metric."""
        for row in self.rows:
            for metric, cell in row.cells[mode].items():
                if cell.effect is not None and cell.effect.verdict is not None:
                    yield row, metric, cell, cell.effect

    def verdicts(self, mode: str) -> Counter[Verdict]:
        """How many of the effects that the paper has come to which verdict in a mode."""
        found = (effect.verdict for _, _, cell, effect in self.effects(mode) if cell.paper_effect)
        return Counter(verdict for verdict in found if verdict is not None)

    def detectable(self, mode: str, metric: str) -> float | None:
        """The smallest difference that every arm's comparison would have seen with 80 % power."""
        known = [
            effect.detectable
            for _, name, _, effect in self.effects(mode)
            if name == metric and effect.detectable is not None
        ]
        return max(known, default=None)
