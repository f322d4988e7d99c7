"""Settings: how the keys of a config are declared, with their rules, defaults and sizes. Imports no torch."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

MISSING = "???"
"""The value of a key that has no default, as OmegaConf writes it."""

SIZES = ("tiny", "small", "paper")
"""The values of `profile.sizes`: for tests, for a CPU, and those of the paper."""


@dataclass(frozen=True)
class Rule:
    """A rule for the values of a key.

    Attributes:
        words: what a value must be, in words that follow "must be".
        allows: returns whether a value obeys the rule.
    """

    words: str
    allows: Callable[[Any], bool]


def one_of(*words: str) -> Rule:
    """Return the rule that a value is one of a few words."""
    return Rule(" or ".join(words), lambda value: value in words)


def within(low: float, high: float = math.inf, *words: str, strict: bool = False) -> Rule:
    """Return the rule that a value is a finite number within limits, or one of a few words.

    The limits are included unless `strict`.
    """

    def allows(value: Any) -> bool:
        if not isinstance(value, int | float) or isinstance(value, bool):
            return value in words
        inside = low < value < high if strict else low <= value <= high
        return inside and math.isfinite(value)

    more, less = ("above", "below") if strict else ("at least", "at most")
    top = f" and {less} {high:g}" if high < math.inf else ""
    return Rule(" or ".join([f"{more} {low:g}{top}", *words]), allows)


def at_least(low: float) -> Rule:
    """Return the rule that a number has a lower limit, which is included."""
    return within(low)


def positive() -> Rule:
    """Return the rule that a number is above 0."""
    return within(0, strict=True)


def fraction() -> Rule:
    """Return the rule that a number is in [0, 1]."""
    return within(0, 1)


def seed() -> Rule:
    """Return the rule for a seed of torch's random numbers."""
    return within(0, 2**63 - 1)


def each(rule: Rule | None = None, empty: bool = False) -> Rule:
    """Return the rule that a value is a list without repetitions, and that each item obeys another rule."""

    def allows(value: Any) -> bool:
        items = list(value)
        if not all(isinstance(item, int | float | str) for item in items):
            return False
        fits = all(rule is None or rule.allows(item) for item in items)
        return fits and len(set(items)) == len(items) and (empty or bool(items))

    what = f", each {rule.words}" if rule else ""
    return Rule(f"a list without repetitions{'' if empty else ', not empty'}{what}", allows)


def text() -> Rule:
    """Return the rule that a text has more than white space."""
    return Rule("text that is not empty", lambda value: bool(value.strip()))


def matching(pattern: str, words: str) -> Rule:
    """Return the rule that a text matches a regular expression, which `words` describe."""
    return Rule(words, lambda value: bool(re.fullmatch(pattern, value)))


def existing(kind: str, *words: str) -> Rule:
    """Return the rule that a value is the path of an existing "file" or "folder", or one of a few words."""

    def allows(value: Any) -> bool:
        path = Path(value)
        return value in words or (path.is_dir() if kind == "folder" else path.is_file())

    return Rule(" or ".join([f"an existing {kind}", *words]), allows)


def clip_folders() -> Rule:
    """Return the rule that a value is the path of an existing folder of clips, or a list of several."""

    def allows(value: Any) -> bool:
        paths = [value] if isinstance(value, str) else list(value) if isinstance(value, Iterable) else []
        known = all(isinstance(path, str) and Path(path).is_dir() for path in paths)
        return bool(paths) and known and len(set(map(Path, paths))) == len(paths)

    words = "an existing folder of npz clips, such as memmlp data import makes, or a list of several"
    return Rule(words, allows)


DEVICE = matching(r"auto|cpu|mps|cuda(:\d+)?", "auto or cpu or cuda or cuda:INDEX or mps")


def setting(rule: Rule | None = None, default: Any = MISSING, **by_profile: Any) -> Any:
    """Declare a key of the config.

    The comment behind the declaration says what the key means; the reference page shows it.

    Args:
        rule: the rule that its values obey; None allows every value of its type.
        default: the default; MISSING for a key that has to be given.
        by_profile: in place of one default, either `tiny`, `small` and `paper`, of which `profile.sizes`
            chooses one, or `default` and `literal`, of which `profile.reading` chooses one. With
            `width_fraction`, a size is that fraction of `profile.width` where this is set.
    """
    metadata = {"rule": rule}
    if "literal" in by_profile:
        return field(default=_choice("reading", default, by_profile["literal"]), metadata=metadata)
    if by_profile:
        return field(default=sized(**by_profile), metadata=metadata)
    if isinstance(default, list | dict):
        return field(default_factory=lambda: type(default)(default), metadata=metadata)
    return field(default=default, metadata=metadata)


def sized(tiny: Any, small: Any, paper: Any, width_fraction: float = 0) -> str:
    """Return a config value of three, from which `profile.sizes` chooses; see `setting`."""
    return _choice("size", tiny, small, paper, *([width_fraction] if width_fraction else []))


def _choice(resolver: str, *values: Any) -> str:
    words = ("null" if value is None else str(value).lower() for value in values)
    return f"${{{resolver}:{','.join(words)}}}"


def group(kind: type, **values: Any) -> Any:
    """Declare a key that is a group of keys, of a dataclass; `values` are their defaults."""
    return field(default_factory=lambda: kind(**values))


@dataclass
class Settings:
    """The keys of a component: the base of all settings that `memmlp.common.components` declares.

    Attributes:
        name: the component's name in the config; the decorator `component` sets it.
        defaults: options of other groups that come with the component, by group; the command line wins.
        recipe: values of other dotted keys that come with the component; the command line wins.
        option: "SLOT=NAME"; the decorator sets it.
    """

    name: str = field(default=MISSING, init=False)

    defaults: ClassVar[dict[str, str | None]] = {}
    recipe: ClassVar[dict[str, Any]] = {}
    option: ClassVar[str] = ""

    @classmethod
    def problems(cls, config: Any) -> Iterator[str]:
        """Yield why the component cannot be used with a config, one line "KEY=VALUE: must be X" each.

        Args:
            config: the whole config, in which every key has a value of its type that obeys its rule.
        """
        yield from ()


@dataclass
class MetricSettings(Settings):
    """The facts of a custom metric; its component has the slot "metric" and builds a function.

    The function takes the prediction and the truth of one clip and returns one number.

    Attributes:
        unit: the unit; empty for a number without one.
        smallest: the smallest difference that matters, in the unit: two methods may differ by this much and
            still count as equally good.
        better: which values are better, "lower" or "higher".
        of: what the function takes: "positions" (N, 22, 3), metres in the world at 60 Hz, in both branches;
            "rotations" (N, 22, 3, 3), local except for the global root's, in the rotation branch.
    """

    unit: ClassVar[str] = ""
    smallest: ClassVar[float] = 0.0
    better: ClassVar[str] = "lower"
    of: ClassVar[str] = "positions"
