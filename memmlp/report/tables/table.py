"""The content of a table: rows of variants, cells of metrics, effects with verdicts."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from memmlp.report.tables.statistics import LEVEL, Verdict
from memmlp.sweep.definition import COSTS

MAX_TIME_RATIO = 1.25  # maximum ratio between two measured times of the same work


class Key(NamedTuple):
    """The key of a table's cell: variant label, evaluation mode and metric."""

    label: str
    mode: str
    metric: str


@dataclass(frozen=True)
class Effect:
    """A variant's difference from its control, over shared seeds and clips.

    Undefined fields are None. Effects on costs have only `mean` and `within_noise`.

    Attributes:
        mean: the mean difference.
        low, high: its 95 % interval.
        p: its p-value, not corrected.
        holm: its p-value, corrected for all comparisons in the table.
        bootstrap: its bootstrap p-value, corrected; None with more than FEW_GROUPS groups.
        equal: the corrected p-value of equivalence (see `memmlp.report.tables.statistics`).
        verdict: the verdict.
        detectable: the smallest difference that this comparison detects with 80 % power.
        seeds, clips, groups: the numbers of paired seeds, clips and clip groups.
        groups_above: the number of groups in which the variant's mean over seeds is higher.
        level: the significance level for corrected p-values.
        decided: the number of seeds at the interim analysis that decided the verdict; None without one.
        within_noise: whether the ratio of two times is at most MAX_TIME_RATIO.
    """

    mean: float
    low: float | None = None
    high: float | None = None
    p: float | None = None
    holm: float | None = None
    bootstrap: float | None = None
    equal: float | None = None
    verdict: Verdict | None = None
    detectable: float | None = None
    seeds: int = 0
    clips: int = 0
    groups: int = 0
    groups_above: int | None = None
    level: float = LEVEL
    decided: int | None = None
    within_noise: bool = False

    @property
    def is_significant(self) -> bool:
        """Whether the difference is significant after the correction."""
        return self.holm is not None and self.holm < self.level


@dataclass(frozen=True)
class Cell:
    """A variant's metric: values by seed, the paper's value, and measured and printed effect.

    Attributes:
        values: the means over clips by seed.
        paper: the paper's value; None without one.
        effect: the measured difference from the control.
        paper_effect: the paper's difference from the control.
        counted, clips: the number of clips with a value, the smallest over seeds, and of all clips.
        low, high: the 95 % interval of the mean over seeds and clip groups; None if undefined.
    """

    values: Mapping[int, float]
    paper: float | None = None
    effect: Effect | None = None
    paper_effect: float | None = None
    counted: int = 0
    clips: int = 0
    low: float | None = None
    high: float | None = None

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
        """True if the paper's effect holds, False if the opposite effect holds; None if undecided.

        The verdict decides. A cost has no verdict, so the sign decides, except for times within noise.
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
        branch: the branch that the errors belong to.
        against: the control's label; None for the sweep's control and for rows with only values from the
            paper.
        note: a remark, or None.
        found: the seeds of finished runs.
        wanted: the planned seeds; empty for a row with only values from the paper.
        cells: the cells by mode and metric.
        pairing: a text that describes the controls in a sweep over axes; empty for a single control.
        branches: the effects with variant and control in another branch than the row's, by branch, mode and
            metric. Each branch has its own correction, and the verdict refers to the paper's effect.
        unrecorded: the branches that the runs of variant or control lack.
        confounded: the differences from the control that the label does not name; None without any.
        series: the label without the overrides of the axes.
        costs: means of the known costs over seeds: COSTS, and `tflop` and `seconds` of the training.
        groups: the number of groups of test clips.
    """

    label: str
    branch: str
    against: str | None
    note: str | None
    found: tuple[int, ...]
    wanted: tuple[int, ...]
    cells: Mapping[str, Mapping[str, Cell]]
    pairing: str = ""
    branches: Mapping[str, Mapping[str, Mapping[str, Effect]]] = field(default_factory=dict)
    unrecorded: tuple[str, ...] = ()
    confounded: str | None = None
    series: str = ""
    costs: Mapping[str, float] = field(default_factory=dict)
    groups: int = 0

    @property
    def is_paper_only(self) -> bool:
        """Whether the row has only values from the paper."""
        return not self.wanted


@dataclass(frozen=True)
class Table:
    """A sweep's variants side by side.

    Attributes:
        name: the sweep's name.
        title: the sweep's title.
        number: the table's number in the paper; None for other tables.
        modes: the evaluation modes; a single mode if only costs are shown.
        metrics: the columns.
        control: the label of the default control.
        branch_source: evidence for the branch of the paper's values; None without such values.
        smallest: the smallest effect of interest by metric.
        comparisons: the number of p-values in the correction.
        rows: the variants.
        notes: remarks on the paper's values.
        flags: warnings about the runs.
        analyses: number of seeds and level of each interim analysis; empty for a fixed number of seeds.
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
        """The error metrics among the columns, without costs."""
        return tuple(metric for metric in self.metrics if metric not in COSTS)

    def list_effects(self, mode: str) -> Iterator[tuple[Row, str, Cell, Effect]]:
        """Yield row, metric, cell and effect for each effect with a verdict in a mode."""
        for row in self.rows:
            for metric, cell in row.cells[mode].items():
                if cell.effect is not None and cell.effect.verdict is not None:
                    yield row, metric, cell, cell.effect

    def count_verdicts(
        self, mode: str, confounded: bool = False, branch: str = "", signed: bool = True
    ) -> Counter[Verdict]:
        """Count the verdicts in a mode, of confounded or of other rows.

        Args:
            mode: the mode of evaluation.
            confounded: whether to count confounded rows, instead of all other rows.
            branch: the branch of variant and control; by default, each row's branch.
            signed: whether to count only effects that the paper prints.
        """
        counts = Counter[Verdict]()
        for row in (row for row in self.rows if bool(row.confounded) == confounded):
            others = row.branches.get(branch, {}).get(mode, {})
            for metric, cell in row.cells[mode].items():
                effect = cell.effect if branch in ("", row.branch) else others.get(metric)
                if effect and effect.verdict and (cell.paper_effect or not signed):
                    counts[effect.verdict] += 1
        return counts

    def find_detectable(self, mode: str, metric: str) -> float | None:
        """Return the smallest difference that every comparison detects with 80 % power; None if unknown.

        Comparisons that cannot detect anything are left out (`list_blind_variants`).
        """
        known = [effect.detectable for _, name, _, effect in self.list_effects(mode) if name == metric]
        return max((one for one in known if one is not None), default=None)

    def list_blind_variants(self, mode: str, metric: str) -> list[str]:
        """Return the labels of variants that cannot detect any difference, such as with one seed."""
        found = [(row.label, row.cells[mode][metric].effect) for row in self.rows]
        return [label for label, effect in found if effect is not None and effect.detectable is None]
