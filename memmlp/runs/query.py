"""Parses conditions on runs, such as "memory=gru and stream.MPJPE<6.3", and collects the values of runs. A
condition consists of comparisons, `and` and `or`; `and` binds more tightly."""

import operator
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from memmlp.common.errors import InputError, suggest
from memmlp.common.files import is_number, to_number
from memmlp.common.overrides import flatten, format_value
from memmlp.runs.identity import SLOTS, find_option, select_training_config
from memmlp.runs.lookup import get_run_name, read_notes
from memmlp.runs.run import STATUSES, Run

Record = Mapping[str, Any]
Condition = Callable[[Record], bool]

COMPARISON = re.compile(
    r'([^\s<>=!"]+)\s*(<=|>=|!=|==|[=<>])\s*(?:"(?P<quoted>[^"]*)"|(?P<word>[^\s<>=!"]+))\s*'
)
JUNCTION = re.compile(r"(and|or)(?:\s+|$)")
ORDER: dict[str, Callable[[Any, Any], bool]] = {
    "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge,
}  # fmt: skip
SHORT = 8  # number of digits in a shortened digest


def build_record(run: Run) -> dict[str, Any]:
    """Return the values of a run that conditions can use, by key.

    - Facts: id, kind, status, name, started, prerequisite, user, tag, note, `data` (the data's name) and
      `data_digest`.
    - All config keys. A slot's name is a short key for its option: `memory` for `memory.name`.
    - Results, such as `stream.rotation.MPJPE`. For the rotation branch, there is also a short key:
      `stream.MPJPE`. The branch after inverse kinematics has the solver in its name:
      `stream.combined-arms.MPJPE`.
    - Times and size of the file that the config requests. If the exported file differs from it, the key names
      the difference: `latency-int8.median_ms`.
    """
    run.check_records()
    manifest, config, notes = run.manifest, run.config, read_notes(run)
    results = {key: to_number(value) for key, value in run.flat_results.items()}
    flat = flatten(config)
    short = {key.replace(".rotation.", "."): value for key, value in results.items()}
    slots = {slot: find_option(config, slot) for slot in SLOTS if slot in config}
    facts = {name: manifest.get(name) for name in ("kind", "started", "prerequisite", "user")}
    digest = str(manifest.get("data") or "")
    facts |= {"data": flat.get("data.name") or digest[:SHORT], "data_digest": digest}
    facts |= {"id": run.id, "name": notes.name or get_run_name(manifest, flat), "status": run.status}
    facts |= {"tag": notes.tags, "note": notes.note}
    return {**flat, **slots, **short, **results, **facts}


def label_data(records: Sequence[Record]) -> list[str]:
    """Return a label for each record's data: its name, with a short digest if the name is ambiguous. The
    record of a VQ-VAE does not name its data; it gets the name from another record with the same data."""
    digests = [str(one.get("data_digest") or "") for one in records]
    pairs = zip(digests, records, strict=True)
    named = {digest: one["data.name"] for digest, one in pairs if "data.name" in one}
    names = [named.get(digest) for digest in digests]
    ambiguous = {name for name in names if len({d for d, own in named.items() if own == name}) > 1}
    return [
        " ".join(filter(None, (name, digest[:SHORT] if name is None or name in ambiguous else ""))) or "-"
        for name, digest in zip(names, digests, strict=True)
    ]


def list_differing_keys(configs: Sequence[Mapping[str, Any]], data: Sequence[str] = ()) -> list[str]:
    """Return the config keys that can change a result and have different values in the configs. If a slot has
    different options, only the slot is returned, and keys inside it only if configs with the same key have
    different values. Keys of the data (`data`: each config's digest) are returned only if they differ between
    data sets with the same name."""
    flats = [flatten(config) for config in configs]
    counting = _list_differing_data_keys(flats, data).union(*map(select_training_config, configs))
    every = list(dict.fromkeys(key for flat in flats for key in flat))
    names = [key for key in every if key in counting or key.startswith(("evaluation.ik", "export.precision"))]
    different = [key for key in names if len({repr(flat.get(key)) for flat in flats}) > 1]
    changed = {key.removesuffix(".name") for key in different if key.endswith(".name")}
    return [
        key.removesuffix(".name")
        for key in different
        if key.endswith(".name")
        or key.split(".")[0] not in changed
        or len({repr(flat[key]) for flat in flats if key in flat}) > 1
    ]


def _list_differing_data_keys(flats: Sequence[Mapping[str, Any]], digests: Sequence[str]) -> set[str]:
    named: dict[Any, dict[str, Mapping[str, Any]]] = {}
    for flat, digest in zip(flats, digests, strict=False):
        named.setdefault(flat.get("data.name"), {}).setdefault(digest, flat)
    return {
        key
        for several in named.values()
        for key in set().union(*several.values())
        if key.startswith("data.") and len({repr(flat.get(key)) for flat in several.values()}) > 1
    }


def format_typed_value(value: Any) -> str:
    """Format a value for a condition or a table column."""
    if isinstance(value, list | tuple):
        return f"[{','.join(map(format_typed_value, value))}]"
    return f"{value:.4g}" if isinstance(value, float) else format_value(value)


def check_key(key: str, records: Iterable[Record], option: str) -> None:
    """Raise InputError if no record has the key."""
    keys = {name for one in records for name in one}
    if key not in keys:
        raise InputError(
            f"{option}: no run has the key '{key}'; {suggest(key, keys)}use a config key (memory, "
            "optim.lr), a result (stream.MPJPE), id, kind, status, name, data, started, tag or note"
        )


class Query(NamedTuple):
    """A parsed condition: a function of a record, the keys in it, and the keys in `numbers`, whose values
    must be numbers because they are compared with <, <=, > or >=."""

    condition: Condition
    keys: tuple[str, ...]
    numbers: tuple[str, ...]

    def match_records(self, records: Sequence[Record]) -> list[bool]:
        """Return which records satisfy the condition. Raises InputError if a key is unknown, or not a number
        for < or >."""
        for key in self.keys if records else ():
            check_key(key, records, "--where")
        for key in self.numbers:
            values = [one[key] for one in records if key in one]
            if values and all(isinstance(value, str | list | tuple) for value in values):
                value = format_typed_value(values[0])
                raise InputError(f"--where: {key} must be a number for < or >, but is {value}; use = or !=")
        return [self.condition(one) for one in records]


def parse_query(text: str) -> Query:
    """Parse a condition. Raises InputError if it is not valid."""

    def fail(expected: str, found: str) -> InputError:
        shown = f"'{found[:20]}'" if found else "the end"
        return InputError(
            f"--where '{text}': expected {expected}, but found {shown}; use comparisons "
            "(= != < <= > >=), and, or"
        )

    groups: list[list[Condition]] = [[]]
    keys, numbers, rest = list[str](), list[str](), text.strip()
    while True:
        match = COMPARISON.match(rest)
        if match is None or match[1] in ("and", "or"):
            raise fail("a comparison", rest)
        key, sign, value = match[1], match[2], match["quoted"] or match["word"] or ""
        keys.append(key)
        if sign in ORDER and key != "started":
            numbers.append(key)
            if _parse_number(value) is None:
                raise fail(f"a number after {key}{sign}", value)
        if key == "status" and value not in STATUSES:
            statuses = ", ".join(STATUSES)
            raise InputError(f"--where '{text}': status={value} must be one of {statuses}")
        groups[-1].append(_make_condition(key, sign, value))
        if not (rest := rest[match.end() :]):
            break
        if (junction := JUNCTION.match(rest)) is None:
            raise fail("and or or", rest)
        rest = rest[junction.end() :]
        if junction[1] == "or":
            groups.append([])
    return Query(
        lambda one: any(all(part(one) for part in group) for group in groups),
        tuple(dict.fromkeys(keys)),
        tuple(dict.fromkeys(numbers)),
    )


def _make_condition(key: str, sign: str, value: str) -> Condition:
    """Return the condition of a comparison; with a missing value or NaN, < and > are false."""
    if sign not in ORDER:
        return lambda one: _is_equal(one.get(key), value) == (sign != "!=")
    compare = ORDER[sign]
    if key == "started":  # ISO 8601 times, which may be typed in part, like 2025-03
        return lambda one: bool(one.get(key)) and compare(str(one[key]), value)
    number = float(value)
    return lambda one: is_number(one.get(key)) and compare(one[key], number)


def _is_equal(actual: Any, value: str) -> bool:
    """Return whether a run's value equals a typed value, which may be rounded like in tables."""
    if isinstance(actual, tuple):  # the tags of a run
        return value in actual
    if is_number(actual):
        return _parse_number(value) in (actual, float(format_typed_value(actual)))
    typed = value.lower() if isinstance(actual, bool | None) else value.replace(", ", ",")
    return format_typed_value(actual) == typed


def _parse_number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
