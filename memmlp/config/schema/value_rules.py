"""The rules for the values of config keys, and the helpers that declare a key with its rule."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import MISSING


@dataclass(frozen=True)
class OneOf:
    """The rule that a value is one of a few words."""

    words: tuple[str, ...]

    def allows(self, value: Any) -> bool:
        """Return whether the value is one of the words."""
        return value in self.words

    def __str__(self) -> str:
        return " or ".join(self.words)


@dataclass(frozen=True)
class Registered:
    """The rule that a value is the name of a component that a user's package has registered."""

    names: Mapping[str, Any]

    def allows(self, value: Any) -> bool:
        """Return whether there is such a component."""
        return value in self.names

    def __str__(self) -> str:
        known = ", ".join(self.names)
        return f"one of {known}" if known else "that of a package of one's own, which plugins=[NAME] uses"


@dataclass(frozen=True)
class OneOfOrPath:
    """The rule that a value is one of a few words, or the dotted path of a custom class."""

    words: tuple[str, ...]

    def allows(self, value: Any) -> bool:
        """Return whether the value is one of the words or looks like a path."""
        return value in self.words or bool(re.fullmatch(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)+", value))

    def __str__(self) -> str:
        return " or ".join([*self.words, "the path of a class of one's own"])


@dataclass(frozen=True)
class Within:
    """The rule that a value is a finite number within limits, or one of a few words.

    The limits are `low` and `high`, inclusive unless `strict`.
    """

    low: float
    high: float = math.inf
    strict: bool = False
    words: tuple[str, ...] = ()

    def allows(self, value: Any) -> bool:
        """Return whether the value is a number within the limits or one of the words."""
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
    """The rule that a value is a list without repetitions whose items all obey another rule.

    An empty list is allowed only with `empty`.
    """

    rule: OneOf | Registered | Within | None = None
    empty: bool = False

    def allows(self, value: Any) -> bool:
        """Return whether every item is allowed and none occurs twice."""
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
    """The rule that a value is text that is not empty."""

    def allows(self, value: Any) -> bool:
        """Return whether the text has more than white space."""
        return bool(value.strip())

    def __str__(self) -> str:
        return "text that is not empty"


@dataclass(frozen=True)
class Matching:
    """The rule that a value is text that matches a pattern, which `said` describes in words."""

    pattern: re.Pattern[str]
    said: str

    def allows(self, value: Any) -> bool:
        """Return whether the whole text matches."""
        return bool(self.pattern.fullmatch(value))

    def __str__(self) -> str:
        return self.said


@dataclass(frozen=True)
class FolderPaths:
    """The rule that a value is the path of an existing folder, or a list of several."""

    def allows(self, value: Any) -> bool:
        """Return whether every folder exists and none occurs twice."""
        paths = [value] if isinstance(value, str) else list(value) if isinstance(value, Iterable) else []
        known = all(isinstance(path, str) and Path(path).is_dir() for path in paths)
        return bool(paths) and known and len(set(map(Path, paths))) == len(paths)

    def __str__(self) -> str:
        return "an existing folder of npz clips, such as memmlp data import makes, or a list of several"


@dataclass(frozen=True)
class Existing:
    """The rule that a value is the path of an existing file or folder, or one of a few words.

    `kind` is "file" or "folder".
    """

    kind: str
    words: tuple[str, ...] = ()

    def allows(self, value: Any) -> bool:
        """Return whether the file or folder exists, or the value is one of the words."""
        path = Path(value)
        return value in self.words or (path.is_dir() if self.kind == "folder" else path.is_file())

    def __str__(self) -> str:
        return " or ".join([f"an existing {self.kind}", *self.words])


def key(rule: object = None) -> Any:
    """Declare a key whose value comes from the YAML file."""
    return field(default=MISSING, metadata={"rule": rule})


DEVICE = Matching(re.compile(r"auto|cpu|mps|cuda(:\d+)?"), "auto or cpu or cuda or cuda:INDEX or mps")


def optional(rule: object = None) -> Any:
    """Declare a key that may be null, which is its value for runs recorded before the key existed."""
    return field(default=None, metadata={"rule": rule})


def with_default(value: object, rule: object = None) -> Any:
    """Declare a key with a default, which is its value for runs recorded before the key existed."""
    return field(default=value, metadata={"rule": rule})


def empty_list(rule: object) -> Any:
    """Declare a list that is empty by default and for runs recorded before the key existed."""
    return field(default_factory=list, metadata={"rule": rule})


def target(path: str) -> Any:
    """Declare the class of a slot's option, which can't be changed."""
    return field(default=path, metadata={"rule": OneOf((path,))})


def called(name: str) -> Any:
    """Declare the name of a slot's option, which can't be changed and enters the identity of a run."""
    return field(default=name, metadata={"rule": OneOf((name,))})


def one_of(*words: str) -> Any:
    """Declare a key that holds one of these words."""
    return key(OneOf(words))


def at_least(low: float) -> Any:
    """Declare a number with a lower limit (inclusive)."""
    return key(Within(low))


def fraction() -> Any:
    """Declare a number in [0, 1]."""
    return key(Within(0, 1))


def positive() -> Any:
    """Declare a number above 0."""
    return key(Within(0, strict=True))
