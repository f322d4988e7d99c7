"""A sweep: variants, seeds, the overrides that train each variant, and its copy beside its plan.

`memmlp.sweep.sweep_file` reads sweep files.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.files import make_json_safe, read_json, write_json
from memmlp.common.overrides import Override
from memmlp.evaluation.metric_facts import SMALLEST

SWEEP_FILE = "sweep.json"
"""The copy of a sweep in its folder: its table can be shown without composing it."""
MODES = ("stream", "window")
BRANCHES = ("rotation", "position", "combined")
SIZES = ("FLOPs", "MACs", "parameters", "size")
"""The costs that a network has before it is trained, on any machine."""
TIMES = ("ms", "network ms", "pose ms", "ratio", "FPS")
"""The costs that are measured in time, so they differ a little each time."""
COSTS = (*SIZES, *TIMES)
"""Metrics that are costs, not errors.

Their units: GFLOP, GMAC, millions, MB, ms, multiples of the yardstick's time, and frames per second.
"""


@dataclass(frozen=True)
class Variant:
    """A row of a table.

    Attributes:
        label: the variant's name in the table.
        overrides: the variant's overrides of the base; None if the row has only the paper's values (a system
            that is not built here).
        branch: whose errors the row shows: rotation, position, or combined (after inverse kinematics).
        paper: the paper's values by metric, as printed.
        note: a remark shown under the table.
        against: the label of the variant that this one is compared with; None for the sweep's control.
        fixed: whether the file gives the variant a branch of its own.
        seeds: the variant's own seeds, if seeds are added only to variants with open verdicts; None for the
            sweep's.
        series: the variant's label in the file, which is the same in all cells of the axes.
        cell: the overrides that the axes add, one per key; empty without axes.
    """

    label: str
    overrides: tuple[str, ...] | None = ()
    branch: str = "rotation"
    paper: Mapping[str, float] | None = None
    note: str | None = None
    against: str | None = None
    fixed: bool = False
    seeds: tuple[int, ...] | None = None
    series: str = ""
    cell: tuple[str, ...] = ()

    @property
    def own_overrides(self) -> tuple[str, ...]:
        """The variant's overrides without those of its cell."""
        return tuple(text for text in self.overrides or () if text not in self.cell)


@dataclass(frozen=True)
class VariantSeed:
    """One training: a variant with a seed, as overrides of `memmlp train`."""

    label: str
    seed: int
    overrides: tuple[str, ...]


@dataclass(frozen=True)
class Sweep:
    """A sweep file, or one with overrides added on the command line.

    Attributes:
        name: the file's stem.
        title: the table's title.
        table: the table's number in the paper; None for a custom sweep.
        notes: remarks shown under the table.
        base: overrides that all variants share.
        seeds: the seeds of each variant.
        variants: the rows in order.
        control: the label of the variant with which the others are compared.
        metrics: the columns.
        command_line: overrides given on the command line.
        branch_source: how we know which branch the paper's values belong to; None if the file does not say.
        smallest: the smallest effect of interest by metric, in its unit; every metric but costs has one.
    """

    name: str
    title: str
    table: int | None
    notes: tuple[str, ...]
    base: tuple[str, ...]
    seeds: tuple[int, ...]
    variants: tuple[Variant, ...]
    control: str
    metrics: tuple[str, ...]
    command_line: tuple[str, ...] = ()
    branch_source: str | None = None
    smallest: Mapping[str, float] = field(default_factory=lambda: SMALLEST)

    def with_branch(self, branch: str) -> Sweep:
        """Return the same sweep with its variants showing another branch.

        A variant with a branch of its own in the file keeps it. The paper's values belong to the branch for
        which they were printed, so variants whose branch changes lose them.

        Raises:
            InputError: for an unknown branch.
        """
        parse_branch(branch, "branch")
        variants = tuple(
            one if one.fixed or one.branch == branch else replace(one, branch=branch, paper={})
            for one in self.variants
        )
        return self if variants == self.variants else replace(self, variants=variants, branch_source=None)

    def control_of(self, variant: Variant) -> str | None:
        """Return the label of a variant's control: its own `against`, or else the sweep's control.

        It is None for the sweep's control itself, unless that variant has an `against`, too.
        """
        return variant.against or (self.control if variant.label != self.control else None)

    def seeds_of(self, variant: Variant) -> tuple[int, ...]:
        """Return the seeds of a variant: its own if it has any, else the sweep's."""
        return self.seeds if variant.seeds is None else variant.seeds

    def with_overrides(self, overrides: Sequence[str]) -> Sweep:
        """Return the same sweep with further overrides, applied after its base and before the variants' own.

        `seed=0,1` or `seed=0` sets the seeds.

        Raises:
            InputError: for an override of the outputs folder, which an option of the command sets, and for a
                key that a variant sets itself, since the variant's value would win.
        """
        keys = [key_of(text) for text in overrides]
        if "paths.outputs" in keys:
            raise InputError("paths.outputs: expected --outputs FOLDER, or MEMMLP_OUTPUTS")
        if "save_predictions" in keys:
            raise InputError(
                "save_predictions: a sweep's runs would overwrite each other's; use memmlp eval RUN "
                "--save-predictions FOLDER"
            )
        setters = {key_of(text): one.label for one in self.runnable() for text in one.overrides or ()}
        others, seeds = [], self.seeds
        for text, key in zip(overrides, keys, strict=True):
            if key == "seed":
                seeds = parse_seeds((Override.parse(text).value or "").split(","), "seed")
                continue
            others.append(text)
            if key in setters:
                raise InputError(
                    f"{text}: variant '{setters[key]}' of sweep {self.name} sets {key} itself; "
                    "expected a key that no variant sets"
                )
        return replace(self, command_line=(*self.command_line, *others), seeds=seeds)

    def all_overrides(self, variant: Variant) -> tuple[str, ...]:
        """Return a variant's overrides: base, command line, its own; the last one of a key wins."""
        texts = (*self.base, *self.command_line, *(variant.overrides or ()))
        return tuple({key_of(text): text for text in texts}.values())

    def runnable(self) -> tuple[Variant, ...]:
        """Return the variants that can be run: all except those with only the paper's values."""
        return tuple(variant for variant in self.variants if variant.overrides is not None)

    def labels_of(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return the labels of the variants that are named, of all that can be run if none is.

        Raises:
            InputError: for a name that no variant has, or a variant with only the paper's values.
        """
        known = [variant.label for variant in self.runnable()]
        if missing := [name for name in names if name not in known]:
            raise InputError(
                f"sweep {self.name}: no variant '{missing[0]}' can be run; expected {', '.join(known)}"
            )
        return tuple(names) or tuple(known)

    def variant_seeds(self) -> list[VariantSeed]:
        """Return the trainings that the sweep needs, variant by variant."""
        return [
            VariantSeed(variant.label, seed, (*self.all_overrides(variant), f"seed={seed}"))
            for variant in self.runnable()
            for seed in self.seeds_of(variant)
        ]


def key_of(override: str) -> str:
    """Return the key or group that an override sets, adds (+) or removes (~)."""
    return Override.parse(override).key


def parse_branch(value: Any, name: str) -> str:
    """Return the name of a branch. Raises InputError, naming the key, for an unknown one."""
    if value not in BRANCHES:
        raise InputError(f"{name}: '{value}'; expected one of {', '.join(BRANCHES)}")
    return value


def parse_seeds(value: Any, name: str) -> tuple[int, ...]:
    """Return the seeds, after a check that they are different whole numbers."""
    texts = [str(item).strip() for item in value] if isinstance(value, list) else []
    if not texts or not all(re.fullmatch(r"\d+", text) for text in texts) or len(set(texts)) < len(texts):
        raise InputError(f"{name}: {value}; expected a list of whole numbers, each once, such as [0, 1, 2]")
    return tuple(map(int, texts))


def save_sweep_copy(sweep: Sweep, folder: Path) -> None:
    """Write the sweep into its folder, unless the folder has the same content already."""
    content = make_json_safe(asdict(sweep))
    if read_json(folder / SWEEP_FILE) != content:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / SWEEP_FILE, content)


def load_sweep_copy(folder: Path) -> Sweep | None:
    """Return the sweep kept in a folder; None without one. Raises InputError if it is damaged."""
    path = folder / SWEEP_FILE
    if not path.exists():
        return None
    try:
        content = json.loads(path.read_bytes())
        content["variants"] = [
            Variant(**_with_tuples(fields, "overrides", "seeds", "cell")) for fields in content["variants"]
        ]
        names = ("notes", "base", "seeds", "variants", "metrics", "command_line")
        return Sweep(**_with_tuples(content, *names))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not a sweep ({error}); start the sweep again") from None


def _with_tuples(fields: dict[str, Any], *names: str) -> dict[str, Any]:
    return {**fields, **{name: tuple(fields[name]) for name in names if fields.get(name) is not None}}
