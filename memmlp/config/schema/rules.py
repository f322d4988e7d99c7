"""What a key of the config may hold, and the helpers that declare it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import MISSING


@dataclass(frozen=True)
class OneOf:
    """One of some words."""

    words: tuple[str, ...]

    def allows(self, value: Any) -> bool:
        """Whether the value is among them."""
        return value in self.words

    def __str__(self) -> str:
        return " or ".join(self.words)


@dataclass(frozen=True)
class Within:
    """A finite number from `low` (`above` it, if `strict`) to `high`, or one of some words."""

    low: float
    high: float = math.inf
    strict: bool = False
    words: tuple[str, ...] = ()

    def allows(self, value: Any) -> bool:
        """Whether the value is in the range or a word."""
        if not isinstance(value, int | float) or isinstance(value, bool):
            return value in self.words
        inside = self.low < value < self.high if self.strict else self.low <= value <= self.high
        return inside and math.isfinite(value)

    def __str__(self) -> str:
        more, less = ("above", "below") if self.strict else ("at least", "at most")
        top = f" and {less} {self.high:g}" if self.high < math.inf else ""
        return " or ".join([f"{more} {self.low:g}{top}", *self.words])


@dataclass(frozen=True)
class EachOf:
    """A list, not empty unless `empty`, without repetitions, of values that a rule allows."""

    rule: OneOf | Within | None = None
    empty: bool = False

    def allows(self, value: Any) -> bool:
        """Whether all items are allowed and there is one of each."""
        items = list(value)
        if not all(isinstance(item, int | float | str) for item in items):
            return False
        fits = all(self.rule is None or self.rule.allows(item) for item in items)
        return fits and len(set(items)) == len(items) and (self.empty or bool(items))

    def __str__(self) -> str:
        what = f", each {self.rule}" if self.rule else ""
        return f"a list without repetitions{'' if self.empty else ', not empty'}{what}"


@dataclass(frozen=True)
class Text:
    """A word that is not empty."""

    def allows(self, value: Any) -> bool:
        """Whether there is more than space."""
        return bool(value.strip())

    def __str__(self) -> str:
        return "text that is not empty"


@dataclass(frozen=True)
class Existing:
    """A file or folder that exists, or one of some words."""

    kind: str
    words: tuple[str, ...] = ()

    def allows(self, value: Any) -> bool:
        """Whether it is there."""
        path = Path(value)
        return value in self.words or (path.is_dir() if self.kind == "folder" else path.is_file())

    def __str__(self) -> str:
        return " or ".join([f"an existing {self.kind}", *self.words])


def key(rule: object = None) -> Any:
    """A key whose value the YAML file gives."""
    return field(default=MISSING, metadata={"rule": rule})


def target(path: str) -> Any:
    """The class that a slot's option stands for; fixed."""
    return field(default=path, metadata={"rule": OneOf((path,))})


def called(name: str) -> Any:
    """The name of a slot's option, by which a run's identity knows it; fixed."""
    return field(default=name, metadata={"rule": OneOf((name,))})


def one_of(*words: str) -> Any:
    """A key with these words."""
    return key(OneOf(words))


def at_least(low: float) -> Any:
    """A number with a lower limit."""
    return key(Within(low))


def fraction() -> Any:
    """A number in [0, 1]."""
    return key(Within(0, 1))


def positive() -> Any:
    """A number above 0."""
    return key(Within(0, strict=True))
