"""Conditions on runs, such as "memory=gru and stream.MPJPE<6.3", and the values that they can use.

A condition is made of comparisons, `and` and `or`; `and` binds more tightly.
"""

from __future__ import annotations

import difflib
import operator
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from memmlp.common.errors import InputError
from memmlp.common.files import to_number
from memmlp.runs.deployment_folder import with_times_as_deployed
from memmlp.runs.evaluation_file import name_solvers
from memmlp.runs.identity import SLOTS, flatten, option_in_slot, training_config
from memmlp.runs.lookup import read_notes, run_name
from memmlp.runs.run import STATUSES, Run

Record = Mapping[str, Any]
Condition = Callable[[Record], bool]

TOKEN = re.compile(r"""\s*(?:(?P<op><=|>=|!=|==|[=<>])|"(?P<quoted>[^"]*)"|(?P<word>[^\s<>=!"]+))""")
ORDER: dict[str, Callable[[Any, Any], bool]] = {
    "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge,
}  # fmt: skip
COMPARISONS = ("=", "==", "!=", *ORDER)
SHORT = 8  # digits of a digest that tell data apart


def record(run: Run) -> dict[str, Any]:
    """Return the values that conditions can use for a run, by key.

    They are its id, kind, status, name, started, prerequisite, user, tag and note; its data by name (`data`)
    and by digest (`data_digest`); the keys of its config, with slots also by their names (`memory` for
    `memory.name`); and its results, with those of the rotation branch also without the branch (`stream.MPJPE`
    for `stream.rotation.MPJPE`), and after inverse kinematics with its name (`stream.combined-arms.MPJPE`).
    Times and size are those of the file that the config asks for; those of another, if only that was
    exported, have its name in the key (`latency-int8.median_ms`).
    """
    manifest, config, notes = run.manifest, run.config, read_notes(run)
    found = name_solvers(run.results, run.evaluations_as_configured.combined_by)
    results = {key: to_number(value) for key, value in flatten(with_times_as_deployed(found)).items()}
    flat = flatten(config)
    short = {key.replace(".rotation.", "."): value for key, value in results.items()}
    slots = {slot: option_in_slot(config, slot) for slot in SLOTS if slot in config}
    facts = {name: manifest.get(name) for name in ("kind", "started", "prerequisite", "user")}
    digest = str(manifest.get("data") or "")
    facts |= {"data": flat.get("data.name") or digest[:SHORT], "data_digest": digest}
    facts |= {"id": run.id, "name": run_name(manifest, flat), "status": run.status}
    facts |= {"tag": notes.tags, "note": notes.note}
    return {**flat, **slots, **short, **results, **facts}


def data_labels(records: Sequence[Record]) -> list[str]:
    """Return the name of each record's data, with a short digest if different data have the same name.

    A record without a name for its data, such as a VQ-VAE's, gets the name that another record has for the
    same data.
    """
    digests = [str(one.get("data_digest") or "") for one in records]
    named = {
        digest: one["data.name"] for digest, one in zip(digests, records, strict=True) if "data.name" in one
    }
    known = [named.get(digest) for digest in digests]
    several = {name for name in known if len({d for d, own in named.items() if own == name}) > 1}
    return [
        " ".join(filter(None, (name, digest[:SHORT] if name is None or name in several else ""))) or "-"
        for name, digest in zip(known, digests, strict=True)
    ]


def differing(configs: Sequence[Mapping[str, Any]], data: Sequence[str] = ()) -> list[str]:
    """Return the config keys that change a result and differ among these configs.

    If the option in a slot differs, its name stands for the keys that only this option has, unless runs with
    that option differ in them. Keys of the data are included only if data with the same name differ in them;
    otherwise the names tell the data apart.

    Args:
        configs: the configs.
        data: the digests of their data.
    """
    flats = [flatten(config) for config in configs]
    counting = {key for config in configs for key in training_config(config)} | _of_data(flats, data)
    counting |= {
        key for flat in flats for key in flat if key.startswith(("evaluation.ik", "export.precision"))
    }
    names = [key for key in dict.fromkeys(key for flat in flats for key in flat) if key in counting]
    different = [key for key in names if len({repr(flat.get(key)) for flat in flats}) > 1]
    changed = {key.removesuffix(".name") for key in different if key.endswith(".name")}
    return [
        key.removesuffix(".name")
        for key in different
        if key.endswith(".name")
        or key.split(".")[0] not in changed
        or len({repr(flat[key]) for flat in flats if key in flat}) > 1
    ]


def _of_data(flats: Sequence[Mapping[str, Any]], digests: Sequence[str]) -> set[str]:
    """Return the data's keys that differ between data with the same name."""
    named: dict[Any, dict[str, Mapping[str, Any]]] = {}
    for flat, digest in zip(flats, digests, strict=False):
        named.setdefault(flat.get("data.name"), {}).setdefault(digest, flat)
    return {
        key
        for several in named.values()
        for key in set().union(*several.values())
        if key.startswith("data.") and len({repr(flat.get(key)) for flat in several.values()}) > 1
    }


def as_typed(value: Any) -> str:
    """Return a value as it is typed in a condition and shown in a column."""
    if isinstance(value, list | tuple):
        return f"[{','.join(map(as_typed, value))}]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:.4g}"
    return "null" if value is None else str(value)


def check_key(key: str, records: Iterable[Record], option: str) -> None:
    """Raise InputError if no run has the key."""
    keys = {name for one in records for name in one}
    if key not in keys:
        near = difflib.get_close_matches(key, keys, n=1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise InputError(
            f"{option}: no run has the key '{key}'; {hint}use keys of the config (memory, optim.lr), results "
            "(stream.MPJPE), id, kind, status, name, data, started, tag or note"
        )


class Query(NamedTuple):
    """A condition, the keys in it, and those among them that it compares with < or > as numbers."""

    condition: Condition
    keys: tuple[str, ...]
    numbers: tuple[str, ...]

    def of(self, records: Sequence[Record], option: str = "--where") -> list[bool]:
        """Return for each record whether it satisfies the condition.

        Raises:
            InputError: for unknown keys, and for keys that have words and are compared as numbers.
        """
        for key in self.keys if records else ():
            check_key(key, records, option)
        for key in self.numbers:
            values = [one[key] for one in records if key in one]
            if values and all(isinstance(value, str | list | tuple) for value in values):
                raise InputError(
                    f"{option}: {key} is not a number in any run ({as_typed(values[0])}); use = or !="
                )
        return [self.condition(one) for one in records]


def parse(text: str) -> Query:
    """Parse a condition. Raises InputError, in one line, if it is not valid."""
    tokens = _Tokens(text)
    groups: list[list[Condition]] = [[]]
    while True:
        groups[-1].append(tokens.comparison())
        if tokens.ended:
            break
        if (word := tokens.next("and or or")[1]) not in ("and", "or"):
            raise tokens.error(f"'{word}' is not expected")
        if word == "or":
            groups.append([])
    keys, numbers = tuple(dict.fromkeys(tokens.keys)), tuple(dict.fromkeys(tokens.numbers))
    return Query(lambda one: any(all(part(one) for part in group) for group in groups), keys, numbers)


class _Tokens:
    """The tokens of a condition, which are read one after another."""

    def __init__(self, text: str):
        self.text, self.rest = text, text.strip()
        self.keys: list[str] = []
        self.numbers: list[str] = []

    @property
    def ended(self) -> bool:
        return not self.rest

    def next(self, expected: str) -> tuple[str, str]:
        """Return the kind and text of the next token."""
        if self.ended:
            raise self.error(f"it ends where {expected} is expected")
        found = TOKEN.match(self.rest)
        if found is None:
            raise self.error(f"'{self.rest[:20]}' cannot be parsed")
        self.rest = self.rest[found.end() :].strip()
        return found.lastgroup or "", found[found.lastgroup or 0]

    def comparison(self) -> Condition:
        """Return the condition of the next comparison, and record its key."""
        kind, key = self.next("a key")
        if kind != "word" or key in ("and", "or"):
            raise self.error(f"'{key}' stands where a key is expected")
        _, sign = self.next(f"a comparison after {key}")
        if sign not in COMPARISONS:
            raise self.error(f"after {key} comes '{sign}'")
        kind, value = self.next(f"a value after {key}{sign}")
        if kind == "op":
            raise self.error(f"after {key}{sign} comes '{value}'")
        if sign in ORDER and _number(value) is None and key != "started":
            raise self.error(f"{key}{sign}{value}: {sign} compares with a number")
        if key == "status" and value not in (*STATUSES, "damaged"):
            known = ", ".join([*STATUSES, "damaged"])
            raise InputError(f"--where '{self.text}': status={value}: must be one of {known}")
        self.keys.append(key)
        if key == "started" and sign in ORDER:  # times in ISO 8601, as much of them as is typed
            return lambda one: bool(one.get(key)) and ORDER[sign](str(one[key]), value)
        self.numbers += [key] if sign in ORDER else []
        return lambda one: _holds(one.get(key), sign, value)

    def error(self, reason: str) -> InputError:
        return InputError(f"--where '{self.text}': {reason}; use comparisons (= != < <= > >=), and, or")


def _holds(own: Any, sign: str, value: str) -> bool:
    """Return whether a comparison holds.

    A missing value is neither smaller nor larger than anything, and neither is NaN, which satisfies only !=.
    """
    if sign in ORDER:
        number = _number(value)
        known = isinstance(own, int | float) and not isinstance(own, bool)
        return known and number is not None and ORDER[sign](own, number)
    return _equal(own, value) == (sign != "!=")


def _equal(own: Any, value: str) -> bool:
    """Return whether a run's value equals a typed one; a number may also be typed as it is shown."""
    if isinstance(own, tuple):  # tags: it has the tag
        return value in own
    if isinstance(own, int | float) and not isinstance(own, bool):
        return _number(value) in (own, float(as_typed(own)))
    typed = value.lower() if isinstance(own, bool | None) else value.replace(", ", ",")
    return as_typed(own) == typed


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
