"""Sweep files: variants (each with a label and overrides of the base), seeds, and the paper's values.

title: Placement of memory blocks in the backbone
table: 14                          # the number in the paper; left out in sweeps of your own
base: [experiment=paper]           # overrides that all variants share
seeds: [0, 1, 2]
control: 2, 4, 6, 8                # the variant that the others are compared with; the first one by default
metrics: [MPJRE, MPJPE, MPJVE, Jitter]
branch: combined                   # whose errors the rows show: rotation (the default), position or combined
branch_source: its last row is Table 6's after inverse kinematics    # how we know the paper's branch
smallest: {MPJPE: 0.1}             # the smallest effect of interest by metric; SMALLEST has the defaults
variants:
  2, 4, 6, 8: {overrides: [], paper: {MPJRE: 2.57}}
  "2": {overrides: ['memory.layers=[2]'], paper: {MPJRE: 2.63}, note: as printed}
  "4": {overrides: ['memory.layers=[4]'], branch: rotation, against: "2"}     # its own branch and control
axes: {model.frames: [11, 21], seed: [0, 1, 2]}      # a grid, instead of variants or over each of them
axes: [{optim.steps: [500, 2000]}, {model.frames: [11]}]           # or a list of grids: the cells of all
"""

from __future__ import annotations

import difflib
import itertools
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from memmlp.common.errors import InputError, why_unreadable
from memmlp.evaluation.metric_facts import SMALLEST, UNITS
from memmlp.sweep.definition import (
    BRANCHES,
    COSTS,
    Sweep,
    Variant,
    key_of,
    parse_branch,
    parse_seeds,
)

KEYS = (
    "title", "table", "notes", "base", "seeds", "control", "metrics", "branch", "branch_source", "smallest",
    "variants", "axes",
)  # fmt: skip
VARIANT_KEYS = ("overrides", "branch", "against", "paper", "note")
BASE = "base"  # the variant of a sweep that has only seeds


class UniqueKeys(yaml.SafeLoader):
    """A safe YAML loader that rejects duplicate keys; plain YAML silently takes the last one."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return the mapping. Raises ConstructorError for a key that occurs twice."""
        seen = set()
        for key, _ in node.value:
            if key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"'{key.value}' twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def load_sweep(path: Path, prepare: Callable[[list[str]], None] = lambda base: None) -> Sweep:
    """Read a sweep file.

    Args:
        path: the file.
        prepare: gets the base before the rest is checked, since the rest may name custom metrics.

    Raises:
        InputError: if something is wrong; the message names file and key.
    """
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), UniqueKeys)
    except OSError as error:
        raise InputError(f"{path}: {why_unreadable(error)}; allowed: a readable sweep file") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not YAML: {why_unreadable(error)}") from None
    try:
        base = content.get("base") if isinstance(content, Mapping) else None
        prepare([word for word in base if isinstance(word, str)] if isinstance(base, list) else [])
        return parse_sweep(path.stem, content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def parse_sweep(name: str, content: Any) -> Sweep:
    """Return the sweep that a file's content describes. Raises InputError, which names the key."""
    content = _mapping(content, "the file", KEYS)
    branch = parse_branch(content.get("branch", BRANCHES[0]), "branch")
    variants = [
        _variant(label, value, branch) for label, value in _labelled(content.get("variants", {})).items()
    ]
    grids, seeds = _axes(content)
    if "axes" in content and not variants:
        variants = [Variant("" if grids else BASE, branch=branch)]  # axes of seeds alone
    variants = list(_over_cells(variants, _cells(grids))) if grids else variants
    runnable = [variant.label for variant in variants if variant.overrides is not None]
    if not runnable:
        raise InputError("variants: none to run; allowed is at least one variant with overrides, or axes")
    control = str(content.get("control", runnable[0]))
    if control not in runnable:
        raise InputError(f"control: '{control}' is no variant; allowed are {', '.join(map(repr, runnable))}")
    _check_controls(variants, runnable)
    source = content.get("branch_source")
    return Sweep(
        name=name,
        title=_text(content.get("title", name), "title"),
        table=_table(content.get("table")),
        notes=tuple(_texts(content.get("notes", []), "notes")),
        base=tuple(_overrides(content.get("base", []), "base")),
        seeds=seeds,
        variants=tuple(variants),
        control=control,
        metrics=_metrics(content.get("metrics", ["MPJRE", "MPJPE", "MPJVE", "Jitter"])),
        branch_source=None if source is None else _text(source, "branch_source"),
        smallest=SMALLEST | _smallest(content.get("smallest", {})),
    )


def _variant(label: str, value: Any, branch: str) -> Variant:
    """Return a variant from its mapping, or from a bare list of its overrides; `branch` is the sweep's."""
    name = f"variants.{label}"
    if isinstance(value, list):
        return Variant(label, tuple(_overrides(value, name)), branch)
    value = _mapping(value or {}, name, VARIANT_KEYS)
    overrides = value.get("overrides", [])
    return Variant(
        label,
        None if overrides is None else tuple(_overrides(overrides, f"{name}.overrides")),
        parse_branch(value.get("branch", branch), f"{name}.branch"),
        _paper(value.get("paper", {}), f"{name}.paper"),
        value.get("note"),
        str(value["against"]) if value.get("against") is not None else None,
        "branch" in value,
    )


def _check_controls(variants: Sequence[Variant], runnable: Sequence[str]) -> None:
    """Raise InputError for a variant that is compared with itself, or with a variant that is not run."""
    for variant in variants:
        others = [label for label in runnable if label != variant.label]
        if variant.against is not None and variant.against not in others:
            raise InputError(
                f"variants.{variant.label}.against: '{variant.against}' is no other variant; "
                f"allowed are {', '.join(map(repr, others))}"
            )


def _axes(content: Mapping[str, Any]) -> tuple[list[dict[str, list[Any]]], tuple[int, ...]]:
    """Return the grids of the axes, none of them empty, and the sweep's seeds.

    Seeds may be an axis of a single grid.
    """
    axes = content.get("axes", {})
    several = isinstance(axes, list)
    if several and not axes:
        raise InputError("axes: an empty list; allowed is a mapping of keys, or a list of such mappings")
    named = [(f"axes[{place}]", grid) for place, grid in enumerate(axes)] if several else [("axes", axes)]
    grids = [dict(_mapping(grid, name)) for name, grid in named]
    own = {} if several else grids[0]
    seeds = parse_seeds(own.pop("seed", content.get("seeds", [0])), "seeds")
    for (name, _), grid in zip(named, grids, strict=True):
        _check_grid(grid, name, several)
    return [grid for grid in grids if grid], seeds


def _check_grid(grid: Mapping[str, Any], name: str, several: bool) -> None:
    """Raise InputError for a grid without cells, or for seeds in one of several grids."""
    if several and not grid:
        raise InputError(f"{name}: empty; allowed is a mapping of at least one key")
    for key, values in grid.items():
        if several and str(key) == "seed":
            raise InputError(f"{name}.seed: allowed in a single grid; the seeds of several are set by seeds")
        if not isinstance(values, list) or not values:
            raise InputError(f"{name}.{key}: allowed is a list of values, not empty")


def _cells(grids: Sequence[Mapping[str, Sequence[Any]]]) -> list[tuple[str, ...]]:
    """Return the cells of all grids as overrides, each cell once, whatever the order of its keys."""
    found: dict[frozenset[str], tuple[str, ...]] = {}
    for grid in grids:
        for values in itertools.product(*grid.values()):
            words = tuple(f"{key}={_word(value)}" for key, value in zip(grid, values, strict=True))
            found.setdefault(frozenset(words), words)
    return list(found.values())


def _over_cells(variants: Sequence[Variant], cells: Sequence[tuple[str, ...]]) -> Iterable[Variant]:
    """Yield every variant in every cell.

    The paper's own variants stay as they are. A variant without a label gets its cell's overrides as label. A
    variant with a control of its own is compared with that control in the same cell.
    """
    for variant in variants:
        if variant.overrides is None:
            yield variant
            continue
        _check_free(variant, cells)
        for words in cells:
            label = ", ".join([variant.label, *words] if variant.label else words)
            control = f"{variant.against}, {', '.join(words)}" if variant.against else None
            overrides = (*variant.overrides, *words)
            yield replace(
                variant, label=label, overrides=overrides, against=control, series=variant.label, cell=words
            )


def _check_free(variant: Variant, cells: Iterable[Sequence[str]]) -> None:
    """Raise InputError if a variant sets a key of an axis, whose values would win over the variant's."""
    own = {key_of(word) for word in variant.overrides or ()}
    axes = {key_of(word) for words in cells for word in words}
    if both := sorted(own & axes):
        raise InputError(
            f"variant '{variant.label}': sets {both[0]}, which is an axis; allowed is one of both"
        )


def _positive(number: Any) -> bool:
    """Return whether a value is a finite number above 0."""
    return isinstance(number, int | float) and not isinstance(number, bool) and 0 < number < math.inf


def _word(value: Any) -> str:
    """Return a value as the text that an override has for it."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return f"[{','.join(map(_word, value))}]"
    return str(value)


def _mapping(value: Any, name: str, keys: Sequence[str] = ()) -> Mapping[str, Any]:
    """Return the value, after a check that it is a mapping with known keys only."""
    if not isinstance(value, Mapping):
        raise InputError(f"{name}: {_kind(value)}; allowed is a mapping")
    for key in value:
        if keys and key not in keys:
            near = difflib.get_close_matches(str(key), keys, n=1)
            hint = f"did you mean {near[0]}? " if near else ""
            where = "" if name == "the file" else f"{name}."
            raise InputError(f"{where}{key}: no such key; {hint}allowed are {', '.join(keys)}")
    return value


def _labelled(value: Any) -> dict[str, Any]:
    """Return the variants by label; a label that YAML reads as a number becomes text."""
    variants = {str(label): variant for label, variant in _mapping(value, "variants").items()}
    if len(variants) < len(value):
        raise InputError("variants: two have the same label")
    for label in variants:
        if not label.isprintable():
            raise InputError(f"variants: {label!r}; allowed is a label of one line")
    return variants


def _overrides(value: Any, name: str) -> list[str]:
    """Return a list of Hydra overrides, checked for their form only; composing them checks their meaning."""
    words = _texts(value, name)
    for word in words:
        if not re.match(r"[+~]*[\w./@]+(=|$)", word):
            raise InputError(f"{name}: '{word}'; allowed is KEY=VALUE or GROUP=OPTION")
        if re.match(r"[+~]*seed(=|$)", word):
            raise InputError(f"{name}: '{word}'; the seeds are set by the key seeds")
    return words


def _texts(value: Any, name: str) -> list[str]:
    if not isinstance(value, list):
        raise InputError(f"{name}: {_kind(value)}; allowed is a list of words")
    return [_text(item, name) for item in value]


def _text(value: Any, name: str) -> str:
    if not isinstance(value, str) or not value.strip():
        raise InputError(f"{name}: {_kind(value)}; allowed is text that is not empty")
    return value


def _table(value: Any) -> int | None:
    if value is None or (isinstance(value, int) and not isinstance(value, bool) and value > 0):
        return value
    raise InputError(f"table: {value!r}; allowed is the number of a table of the paper")


def _metrics(value: Any) -> tuple[str, ...]:
    """Return the names of the columns, after a check that they are metrics or costs."""
    names = _texts(value, "metrics")
    if not names:
        raise InputError("metrics: empty; allowed is at least one")
    for name in names:
        if name not in UNITS and name not in COSTS:
            raise InputError(f"metrics: '{name}'; allowed are {', '.join([*UNITS, *COSTS])}")
    return tuple(names)


def _paper(value: Any, name: str) -> dict[str, float]:
    """Return the paper's values by metric."""
    values = dict(_mapping(value or {}, name, [*UNITS, *COSTS]))
    for metric, number in values.items():
        if not isinstance(number, int | float) or isinstance(number, bool):
            raise InputError(f"{name}.{metric}: {number!r}; allowed is a number")
    return values


def _smallest(value: Any) -> dict[str, float]:
    """Return the smallest effects of interest by metric."""
    values = dict(_mapping(value or {}, "smallest", [*UNITS]))
    for metric, number in values.items():
        if not _positive(number):
            raise InputError(f"smallest.{metric}: {number!r}; allowed is a number above 0")
    return values


def _kind(value: Any) -> str:
    """Describe a value of the wrong kind for an error message."""
    return "nothing" if value is None else f"{value!r}"[:60]
