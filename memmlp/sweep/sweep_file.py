"""Sweep files: variants (each with a label and overrides of the base), seeds, and the paper's values.

title: Placement of memory blocks in the backbone
table: 14                          # the table's number in the paper; omitted in custom sweeps
base: [experiment=paper]           # overrides that all variants share
seeds: [0, 1, 2]
control: 2, 4, 6, 8                # the variant with which all others are compared; by default, the first
metrics: [MPJRE, MPJPE, MPJVE, Jitter]
branch: combined                   # the branch that rows show: rotation (default), position or combined
branch_source: its last row is Table 6's after inverse kinematics    # evidence for the paper's branch
smallest: {MPJPE: 0.1}             # the smallest effect of interest by metric; defaults are in SMALLEST
variants:
  2, 4, 6, 8: {overrides: [], paper: {MPJRE: 2.57}}
  "2": {overrides: ['memory.layers=[2]'], paper: {MPJRE: 2.63}, note: as printed}
  "4": {overrides: ['memory.layers=[4]'], branch: rotation, against: "2"}     # its own branch and control
  other: {overrides: [model=agrol_mlp], confounded: the loss changes too}     # its verdicts count apart
axes: {model.frames: [11, 21], seed: [0, 1, 2]}      # a grid, in which each variant is repeated
axes: [{optim.steps: [500, 2000]}, {model.frames: [11]}]           # or several grids
"""

import itertools
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from memmlp.common.errors import InputError, describe_read_error, escape_line_breaks, suggest
from memmlp.common.overrides import format_value
from memmlp.common.schema import parse_config_yaml
from memmlp.evaluation.metric_facts import SMALLEST, UNITS
from memmlp.sweep.definition import BRANCHES, COSTS, Sweep, Variant, parse_branch, parse_key, parse_seeds

KEYS = (
    "title", "table", "notes", "base", "seeds", "control", "metrics", "branch", "branch_source", "smallest",
    "variants", "axes",
)  # fmt: skip
VARIANT_KEYS = ("overrides", "branch", "against", "paper", "note", "confounded")
MAX_NAME_BYTES = 200  # of a sweep file's stem; folders have longer names
BASE = "base"  # the variant's label in a sweep without variants and grids


def load_sweep(path: Path, prepare: Callable[[list[str]], None] = lambda base: None) -> Sweep:
    """Read a sweep file. Its stem names the sweep's folder. `prepare` is called with the base before the
    other keys are checked, because they may name custom metrics. Raises InputError for invalid content."""
    name = path.stem
    if not name.isprintable() or not name.strip(". ") or len(name.encode()) > MAX_NAME_BYTES:
        expected = f"must be printable, not only dots, and at most {MAX_NAME_BYTES} bytes long"
        raise InputError(f"{path.parent}: the name {name!r} {expected}; rename the sweep file")
    try:
        content = parse_config_yaml(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: {describe_read_error(error)}; expected a readable sweep file") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected YAML ({describe_read_error(error)})") from None
    try:
        base = content.get("base") if isinstance(content, Mapping) else None
        prepare([text for text in base if isinstance(text, str)] if isinstance(base, list) else [])
        return parse_sweep(name, content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def parse_sweep(name: str, content: Any) -> Sweep:
    """Return the sweep that a file's content describes. Raises InputError for invalid content."""
    content = _parse_mapping(content, "the file", KEYS)
    branch = parse_branch(content.get("branch", BRANCHES[0]), "branch")
    variants = _parse_variants(content.get("variants", {}), branch)
    grids, seeds = _parse_axes(content)
    if "axes" in content and not variants:
        variants = [Variant("" if grids else BASE, branch=branch)]
    variants = list(_repeat_in_cells(variants, _list_cells(grids))) if grids else variants
    runnable = [variant.label for variant in variants if variant.overrides is not None]
    if not runnable:
        raise InputError("variants: expected at least one variant with overrides, or axes")
    control = str(content.get("control", runnable[0]))
    if control not in runnable:
        raise InputError(f"control: '{control}'; expected one of {', '.join(map(repr, runnable))}")
    for variant in variants:
        if variant.against is not None and variant.against not in {*runnable} - {variant.label}:
            wrong = f"variants.{variant.label}.against: '{variant.against}'"
            raise InputError(f"{wrong}; expected another variant with overrides")
    table = content.get("table")
    if table is not None and (isinstance(table, bool) or not isinstance(table, int) or table < 1):
        raise InputError(f"table: {table!r}; expected the number of a table of the paper")
    metrics = _parse_texts(content.get("metrics", ["MPJRE", "MPJPE", "MPJVE", "Jitter"]), "metrics")
    if not metrics or not {*metrics} <= {*UNITS, *COSTS}:
        raise InputError(f"metrics: {metrics}; expected a list of {', '.join([*UNITS, *COSTS])}")
    smallest = _parse_numbers(content.get("smallest", {}), "smallest", [*UNITS])
    for metric, number in smallest.items():
        if not 0 < number < math.inf:
            raise InputError(f"smallest.{metric}: {number!r}; must be above 0")
    source = content.get("branch_source")
    return Sweep(
        name=name,
        title=_parse_text(content.get("title", name), "title"),
        table=table,
        notes=tuple(_parse_texts(content.get("notes", []), "notes")),
        base=tuple(_parse_overrides(content.get("base", []), "base")),
        seeds=seeds,
        variants=tuple(variants),
        control=control,
        metrics=tuple(metrics),
        branch_source=None if source is None else _parse_text(source, "branch_source"),
        smallest=SMALLEST | smallest,
    )


def _parse_variants(value: Any, branch: str) -> list[Variant]:
    named = _parse_mapping(value, "variants").items()
    variants = [_parse_variant(str(label), fields, branch) for label, fields in named]
    if len({variant.label for variant in variants}) < len(variants):
        raise InputError("variants: two variants have the same label")
    for variant in variants:
        if not variant.label.strip() or escape_line_breaks(variant.label) != variant.label:
            raise InputError(f"variants: {variant.label!r}; expected a label in one line")
    return variants


def _parse_variant(label: str, value: Any, branch: str) -> Variant:
    name = f"variants.{label}"
    if isinstance(value, list):
        return Variant(label, tuple(_parse_overrides(value, name)), branch)
    value = _parse_mapping(value or {}, name, VARIANT_KEYS)
    overrides, confounded = value.get("overrides", []), value.get("confounded")
    return Variant(
        label,
        None if overrides is None else tuple(_parse_overrides(overrides, f"{name}.overrides")),
        parse_branch(value.get("branch", branch), f"{name}.branch"),
        _parse_numbers(value.get("paper", {}), f"{name}.paper", [*UNITS, *COSTS]),
        value.get("note"),
        str(value["against"]) if value.get("against") is not None else None,
        "branch" in value,
        confounded=None if confounded is None else _parse_text(confounded, f"{name}.confounded"),
    )


def _parse_axes(content: Mapping[str, Any]) -> tuple[list[dict[str, list[Any]]], tuple[int, ...]]:
    """Return the grids of the axes that are not empty, and the sweep's seeds, which a single grid may have as
    an axis."""
    axes = content.get("axes", {})
    several = isinstance(axes, list)
    if several and not axes:
        raise InputError("axes: empty; expected a mapping of keys, or a list of such mappings")
    named = [(f"axes[{place}]", grid) for place, grid in enumerate(axes)] if several else [("axes", axes)]
    grids = [(name, dict(_parse_mapping(grid, name))) for name, grid in named]
    seeds = content.get("seeds", [0])
    if not several:
        seeds = grids[0][1].pop("seed", seeds)
    for name, grid in grids:
        if several and not grid:
            raise InputError(f"{name}: empty; expected a mapping of at least one key")
        for key, values in grid.items():
            if several and str(key) == "seed":
                raise InputError(f"{name}.seed: expected the key seeds for several grids")
            if not isinstance(values, list) or not values:
                raise InputError(f"{name}.{key}: expected a list of values")
    return [grid for _, grid in grids if grid], parse_seeds(seeds, "seeds")


def _list_cells(grids: Sequence[Mapping[str, Sequence[Any]]]) -> list[tuple[str, ...]]:
    found: dict[frozenset[str], tuple[str, ...]] = {}
    for grid in grids:
        for values in itertools.product(*grid.values()):
            cell = tuple(f"{key}={format_value(value)}" for key, value in zip(grid, values, strict=True))
            found.setdefault(frozenset(cell), cell)
    return list(found.values())


def _repeat_in_cells(variants: Sequence[Variant], cells: Sequence[tuple[str, ...]]) -> Iterable[Variant]:
    """Yield each variant in each cell of the grids, with the cell's overrides in its label. A variant's own
    control becomes the control in the same cell. Rows with only the paper's values are not repeated."""
    axes = {parse_key(text) for cell in cells for text in cell}
    for variant in variants:
        if variant.overrides is None:
            yield variant
            continue
        if both := sorted(axes & {parse_key(text) for text in variant.overrides}):
            wrong = f"sets {both[0]}, which is also an axis"
            raise InputError(f"variant '{variant.label}': {wrong}; remove one of them")
        for cell in cells:
            yield replace(
                variant,
                label=", ".join([variant.label, *cell] if variant.label else cell),
                overrides=(*variant.overrides, *cell),
                against=f"{variant.against}, {', '.join(cell)}" if variant.against else None,
                series=variant.label,
                cell=cell,
            )


def _parse_mapping(value: Any, name: str, keys: Sequence[str] = ()) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise InputError(f"{name}: {_show_value(value)}; expected a mapping")
    for key in value:
        if keys and key not in keys:
            where = "" if name == "the file" else f"{name}."
            expected = f"{suggest(str(key), keys)}expected one of {', '.join(keys)}"
            raise InputError(f"{where}{key}: no such key; {expected}")
    return value


def _parse_overrides(value: Any, name: str) -> list[str]:
    """Return a list of Hydra overrides. Only their syntax is checked; composing checks keys and values."""
    texts = _parse_texts(value, name)
    for text in texts:
        if not re.match(r"[+~]*[\w./@]+(=|$)", text):
            raise InputError(f"{name}: '{text}'; expected KEY=VALUE or GROUP=OPTION")
        if parse_key(text) == "seed":
            raise InputError(f"{name}: '{text}'; expected the key seeds for seeds")
    return texts


def _parse_texts(value: Any, name: str) -> list[str]:
    if not isinstance(value, list):
        raise InputError(f"{name}: {_show_value(value)}; expected a list of texts")
    return [_parse_text(item, name) for item in value]


def _parse_text(value: Any, name: str) -> str:
    if not isinstance(value, str) or not value.strip():
        raise InputError(f"{name}: {_show_value(value)}; expected text")
    return value


def _parse_numbers(value: Any, name: str, keys: Sequence[str]) -> dict[str, float]:
    values = dict(_parse_mapping(value or {}, name, keys))
    for metric, number in values.items():
        if not isinstance(number, int | float) or isinstance(number, bool):
            raise InputError(f"{name}.{metric}: {number!r}; expected a number")
    return values


def _show_value(value: Any) -> str:
    return "nothing" if value is None else f"{value!r}"[:60]
