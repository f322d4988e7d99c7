"""The functions that templates of pages can call."""

import contextlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from statistics import median

from docs.results.table_page import BRANCHES, KeptTable, make_markdown_table
from memmlp.common.errors import InputError
from memmlp.common.text_formats import escape_markdown
from memmlp.report.tables.statistics import Verdict
from memmlp.report.tables.table import Table
from memmlp.report.tables.table_text import (
    CONFOUNDED,
    MISSING,
    find_unit,
    format_counts,
    format_mean,
    make_caption,
)

TRIALS = "budget_trials.csv"
SEARCHED = (
    "optim", "optim.lr", "optim.weight_decay", "optim.batch", "profile.scale", "data.mirror", "loss",
)  # fmt: skip
RECIPE = "recipe"  # the trial of a network's own optimiser settings; other trials have numbers
DIVERGED = "inf"  # MPJPE of a trial whose loss became infinite
Trial = Mapping[str, str]  # a line of TRIALS
UNDECIDED = (Verdict.INCONCLUSIVE, Verdict.EQUIVALENT)


class Placeholders:
    """The functions that templates can call. An unknown name raises InputError with the valid names."""

    def __init__(self, sources: Mapping[str, KeptTable], trials: Sequence[Trial]):
        self.sources, self._trials = sources, trials
        self._regrouped: dict[tuple[str, tuple[str, ...], bool], Table] = {}

    def collect_functions(self) -> dict[str, object]:
        """Return the functions by name, and the list `names` of all results."""
        methods = {name: getattr(self, name) for name in dir(self) if not name.startswith("_")}
        return {**methods, "names": sorted(self.sources)}

    def claims(self, names: Sequence[str], joined: str = "", mode: str = "stream") -> str:
        """Return a table with the verdicts on the paper's effects: a line for each table, a column a branch.

        Only effects with a sign in the paper count. Confounded rows count apart, after their mark.

        Args:
            names: the names of the tables' results.
            joined: a regular expression; clips with equal matches are one group in an additional last line.
            mode: the mode of evaluation.
        """
        tables = {name: self._find_table(name) for name in names}
        counted = {_link(make_caption(table), name): [table] for name, table in tables.items()}
        counted["all"] = [*tables.values()]
        if joined:
            counted["all, contents joined"] = [self._find_table(name, joined) for name in names]
        lines = (
            [head, *(self._count_claims(found, mode, branch) for branch in BRANCHES)]
            for head, found in counted.items()
        )
        return make_markdown_table(["table", *BRANCHES.values()], lines)

    def decisions(
        self,
        names: Sequence[str],
        verdict: str,
        mode: str = "stream",
        confounded: bool = False,
        joined: str = "",
        above_margin: bool = False,
        weigh_groups: bool = False,
    ) -> str:
        """Return the effects with a verdict such as `holds`, in the branch that the paper prints.

        Args:
            names: the names of the tables' results.
            verdict: the verdict.
            mode: the mode of evaluation.
            confounded: whether to list only confounded rows, instead of all other rows.
            joined: a regular expression; clips with equal matches are one group.
            above_margin: whether the paper's own effect must exceed the smallest effect of interest.
            weigh_groups: whether each group of clips has the same weight.
        """
        found: dict[str, list[str]] = {}
        for name in names:
            table = self._find_table(name, joined, weigh_groups)
            for row, metric, cell, effect in table.list_effects(mode):
                small = above_margin and abs(cell.paper_effect or 0) <= table.smallest.get(metric, 0)
                if effect.verdict == verdict and not small and bool(row.confounded) == confounded:
                    head = f"Table {table.number} " if table.number else ""
                    found.setdefault(f"{head}'{row.label}'", []).append(metric)
        return escape_markdown("; ".join(f"{row}: {', '.join(metrics)}" for row, metrics in found.items()))

    def overview(self, *patterns: str) -> str:
        """Return a table of all pages: runs, seeds, and significant differences in the first mode.

        Args:
            patterns: regular expressions; with equal matches of a pattern, clips become one group in the
                last column.
        """
        lines, captions = [], [make_caption(one.table) for one in self.sources.values()]
        for name, source in sorted(self.sources.items()):
            if not source.table.measured_metrics:
                continue
            caption = make_caption(source.table)
            seeds = sorted({len(row.found) for row in source.table.rows if row.found})
            coarse = MISSING
            with contextlib.suppress(InputError):  # no clips to merge
                coarse = self._count_significant(self._regroup(name, patterns))
            caption = f"{caption} ({name})" if captions.count(caption) > 1 else caption
            numbers = [str(source.kept.run_count), " to ".join(map(str, sorted({*seeds[:1], *seeds[-1:]})))]
            lines.append([_link(caption, name), *numbers, self._count_significant(source.table), coarse])
        heads = ["page", "runs", "seeds", "significant differences", "the same with contents joined"]
        return make_markdown_table(heads, lines)

    def lowest(self, name: str, *metrics: str, mode: str = "stream") -> str:
        """Return the variant with the lowest error of a table, for each metric. Variants with one seed do not
        count in a table where others have more."""
        texts, table = [], self._find_table(name)
        rows = [row for row in table.rows if len(row.found) > 1] or table.rows
        for metric in metrics:
            cells = [(row.cells[mode][metric], row.label) for row in rows]
            cell, label = min(
                (one for one in cells if one[0].mean is not None), key=lambda one: one[0].mean or 0.0
            )
            texts.append(f"{metric} {format_mean(cell, metric)} {find_unit(metric)} ('{label}')")
        return escape_markdown(", ".join(texts))

    def searches(self, trials: int, tflop: float) -> str:
        """Return a table of a search at equal compute, with the best of the first random trials and the trial
        of the network's own recipe. Networks that lack one of these are left out. A diverged trial's MPJPE is
        inf. Raises InputError if another trial's compute differs from `tflop` by more than 5 %."""
        wanted = [*map(str, range(trials)), RECIPE]
        by_network: dict[str, dict[str, Trial]] = {}
        for trial in self._trials:
            if trial["MPJPE"] != DIVERGED and not 0.95 <= float(trial["tflop"]) / tflop <= 1.05:
                raise InputError(f"{TRIALS}: {trial['network']} {trial['trial']}: must have {tflop} TFLOP")
            by_network.setdefault(trial["network"], {})[trial["trial"]] = trial
        lines = []
        for network, found in by_network.items():
            if not found.keys() >= {*wanted}:
                continue
            counted = [found[name] for name in wanted]
            errors = sorted(float(one["MPJPE"]) for one in counted)
            best = min(counted, key=lambda one: float(one["MPJPE"]))
            values = ", ".join(best[column] for column in SEARCHED)
            cells = [network, f"{errors[0]:.2f}", f"{median(errors):.2f}", best["trial"], values]
            lines.append((errors[0], cells))
        names = ", ".join(column.rpartition(".")[2] for column in SEARCHED)
        heads = ["network", "best", "median", "trial", names]
        return make_markdown_table(heads, [line for _, line in sorted(lines)])

    def counted_compute(self) -> str:
        """Return the range of the trials' training compute."""
        counted = [float(trial["tflop"]) for trial in self._trials if trial["MPJPE"] != DIVERGED]
        return f"{min(counted):.3g} to {max(counted):.3g} TFLOP"

    def _count_claims(self, tables: Iterable[Table], mode: str, branch: str) -> str:
        counts: dict[str, Counter[Verdict]] = {"": Counter(), f"{CONFOUNDED} ": Counter()}
        for table in tables:
            for mark, found in counts.items():
                found.update(table.count_verdicts(mode, bool(mark), branch))
        return (
            "; ".join(f"{mark}{format_counts(found)}" for mark, found in counts.items() if found) or MISSING
        )

    def _count_significant(self, table: Table) -> str:
        counts = [Counter[bool](), Counter[bool]()]
        for row, *_, effect in table.list_effects(table.modes[0]):
            counts[bool(row.confounded)][effect.verdict not in UNDECIDED] += 1
        sound, apart = (f"{found[True]} of {found.total()}" for found in counts)
        return f"{sound}; {CONFOUNDED} {apart}" if counts[1] else sound

    def _find_table(self, name: str, joined: str = "", weigh_groups: bool = False) -> Table:
        if name not in self.sources:
            choices = ", ".join(sorted(self.sources)) or "none"
            raise InputError(f"'{name}': results must be one of {choices}")
        patterns = (joined,) if joined else ()
        other = patterns or weigh_groups
        return self._regroup(name, patterns, weigh_groups) if other else self.sources[name].table

    def _regroup(self, name: str, patterns: tuple[str, ...], weigh_groups: bool = False) -> Table:
        """Return a table with other clip groups, which takes seconds to compute, at most once."""
        key = name, patterns, weigh_groups
        if key not in self._regrouped:
            self._regrouped[key] = self.sources[name].regroup(patterns, weigh_groups)
        return self._regrouped[key]


def _link(caption: str, name: str) -> str:
    return f"[{escape_markdown(caption)}]({name}.md)"
