"""A sweep: its variants, their overrides, its seeds, and the copy of the sweep beside its plan."""

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

SWEEP_FILE = "sweep.json"  # the sweep's copy, from which its table is shown without composing configs
MODES = ("stream", "window")
BRANCHES = ("rotation", "position", "combined")  # combined: after inverse kinematics
SIZES = ("FLOPs", "MACs", "parameters", "size")  # costs that do not depend on training or machine
TIMES = ("ms", "network ms", "pose ms", "ratio", "FPS")  # costs from measured times, which vary slightly
COSTS = (*SIZES, *TIMES)
"""Metrics that are costs, not errors, in GFLOP, GMAC, millions, MB, ms, multiples of the reference network's
time, and frames per second."""


@dataclass(frozen=True)
class Variant:
    """A row of a table. `overrides` are None for a row with only the paper's values, such as a system that
    memmlp does not implement. `seeds` are None for those of the sweep; a variant has its own if seeds are
    added only to variants with inconclusive verdicts."""

    label: str  # the variant's name in the table
    overrides: tuple[str, ...] | None = ()  # of the base
    branch: str = "rotation"  # the branch that the row shows, one of BRANCHES
    paper: Mapping[str, float] | None = None  # the paper's values by metric, as printed
    note: str | None = None  # a remark shown under the table
    against: str | None = None  # the label of the variant's control; None for the control of the sweep
    fixed: bool = False  # whether the sweep file sets the branch for this variant
    seeds: tuple[int, ...] | None = None
    series: str = ""  # the variant's label in the file, without the overrides of the axes
    cell: tuple[str, ...] = ()  # the overrides that the axes add, one per key; empty without axes
    confounded: str | None = None  # other differences from the control that the label does not name

    @property
    def own_overrides(self) -> tuple[str, ...]:
        """The overrides without those of the cell."""
        return tuple(text for text in self.overrides or () if text not in self.cell)


@dataclass(frozen=True)
class Sweep:
    """The content of a sweep file, with overrides added on the command line. `smallest` is the smallest
    effect of interest for each metric except costs, in the metric's unit."""

    name: str  # the file's stem
    title: str  # the table's title
    table: int | None  # the table's number in the paper; None for a custom sweep
    notes: tuple[str, ...]  # remarks shown under the table
    base: tuple[str, ...]  # overrides that all variants share
    seeds: tuple[int, ...]  # the seeds of each variant
    variants: tuple[Variant, ...]  # the rows in order
    control: str  # the label of the variant with which all other variants are compared
    metrics: tuple[str, ...]  # the columns
    command_line: tuple[str, ...] = ()  # overrides given on the command line
    branch_source: str | None = None  # the evidence for the branch of the paper's values
    smallest: Mapping[str, float] = field(default_factory=lambda: SMALLEST)

    def with_branch(self, branch: str) -> Sweep:
        """Return the sweep with variants that show this branch, except where the file sets a variant's own.
        The paper's values belong to the printed branch, so a variant loses them when its branch changes."""
        variants = tuple(
            one if one.fixed or one.branch == branch else replace(one, branch=branch, paper={})
            for one in self.variants
        )
        return self if variants == self.variants else replace(self, variants=variants, branch_source=None)

    def find_control(self, variant: Variant) -> str | None:
        """Return the label of a variant's control: `against` if it is set, else the sweep's control, or None
        for this control itself."""
        return variant.against or (self.control if variant.label != self.control else None)

    def get_seeds(self, variant: Variant) -> tuple[int, ...]:
        return self.seeds if variant.seeds is None else variant.seeds

    def with_overrides(self, overrides: Sequence[str]) -> Sweep:
        """Return the sweep with further overrides, applied after its base and before the variants' overrides.
        `seed=0,1` or `seed=0` sets the seeds. Raises InputError for `paths.outputs`, which `--outputs` sets;
        for `save_predictions`; and for a key that a variant sets to a value, because that value would win."""
        keys = [parse_key(text) for text in overrides]
        if "paths.outputs" in keys:
            raise InputError("paths.outputs: expected --outputs FOLDER, or MEMMLP_OUTPUTS")
        if "save_predictions" in keys:
            advice = "use memmlp eval RUN --save-predictions FOLDER"
            raise InputError(f"save_predictions: the runs would overwrite each other's predictions; {advice}")
        setters = {
            parse_key(text): one.label
            for one in self.list_runnable()
            for text in one.overrides or ()
            if not text.endswith("=null")  # the variant does without it, whatever the others have
        }
        others, seeds = [], self.seeds
        for text, key in zip(overrides, keys, strict=True):
            if key == "seed":
                seeds = parse_seeds((Override.parse(text).value or "").split(","), "seed")
                continue
            others.append(text)
            if key in setters:
                wrong = f"{text}: variant '{setters[key]}' of sweep {self.name} already sets {key}"
                raise InputError(f"{wrong}; expected a key that no variant sets")
        return replace(self, command_line=(*self.command_line, *others), seeds=seeds)

    def merge_overrides(self, variant: Variant) -> tuple[str, ...]:
        """Return the overrides of the base, the command line and the variant; the last one for a key wins."""
        texts = (*self.base, *self.command_line, *(variant.overrides or ()))
        return tuple({parse_key(text): text for text in texts}.values())

    def list_runnable(self) -> tuple[Variant, ...]:
        """Return all variants except rows with only the paper's values."""
        return tuple(variant for variant in self.variants if variant.overrides is not None)

    def select_labels(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return the given labels; without any, the labels of all variants that can be run. Raises InputError
        for an unknown label, or a row with only the paper's values."""
        labels = [variant.label for variant in self.list_runnable()]
        if missing := [name for name in names if name not in labels]:
            wrong = f"sweep {self.name}: no variant '{missing[0]}' can be run"
            raise InputError(f"{wrong}; expected {', '.join(labels)}")
        return tuple(names) or tuple(labels)


def parse_key(override: str) -> str:
    """Return the key or group that an override sets, adds (+) or removes (~)."""
    return Override.parse(override).key


def parse_branch(value: Any, name: str) -> str:
    """Return the value if it is a branch's name, else raise InputError, which names the key."""
    if value not in BRANCHES:
        raise InputError(f"{name}: '{value}'; expected one of {', '.join(BRANCHES)}")
    return value


def parse_seeds(value: Any, name: str) -> tuple[int, ...]:
    """Return the seeds. Raises InputError unless they are different whole numbers."""
    texts = [str(item).strip() for item in value] if isinstance(value, list) else []
    if not texts or not all(re.fullmatch(r"\d+", text) for text in texts) or len(set(texts)) < len(texts):
        raise InputError(f"{name}: {value}; expected a list of whole numbers, each once, such as [0, 1, 2]")
    return tuple(map(int, texts))


def save_sweep_copy(sweep: Sweep, folder: Path) -> None:
    """Write the sweep into its folder, unless the file already has this content."""
    content = make_json_safe(asdict(sweep))
    if read_json(folder / SWEEP_FILE) != content:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / SWEEP_FILE, content)


def load_sweep_copy(folder: Path) -> Sweep | None:
    """Return the copy of a sweep in its folder, or None. Raises InputError for a damaged file."""
    path = folder / SWEEP_FILE
    if not path.exists():
        return None
    try:
        content = json.loads(path.read_bytes())
        variants = (_with_tuples(fields, "overrides", "seeds", "cell") for fields in content["variants"])
        content["variants"] = [Variant(**fields) for fields in variants]
        names = ("notes", "base", "seeds", "variants", "metrics", "command_line")
        return Sweep(**_with_tuples(content, *names))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: must be a sweep ({error}); start the sweep again") from None


def _with_tuples(fields: dict[str, Any], *names: str) -> dict[str, Any]:
    return {**fields, **{name: tuple(fields[name]) for name in names if fields.get(name) is not None}}
