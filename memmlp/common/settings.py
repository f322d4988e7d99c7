"""Declares config keys, with their rules, defaults and sizes. This module does not import torch."""

import math
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

MISSING = "???"
"""OmegaConf's value for a key without a default."""

SIZES = ("tiny", "small", "paper")
"""The values of `profile.sizes`: sizes for tests, sizes for a CPU, and the paper's sizes."""

PRECISIONS = ("fp32", "int8", "fp16")
"""The values of `export.precision`."""


@dataclass(frozen=True)
class Rule:
    """A rule for the values of a key: `allows` checks a value; messages put `words` behind "must be"."""

    words: str
    allows: Callable[[Any], bool]


def one_of(*words: str) -> Rule:
    """Return the rule that a value must be one of the words."""
    return Rule(" or ".join(words), lambda value: value in words)


def within(low: float, high: float = math.inf, *words: str, strict: bool = False) -> Rule:
    """Return the rule that a value must be within limits (excluded if `strict`), or one of the words."""

    def allows(value: Any) -> bool:
        if not isinstance(value, int | float) or isinstance(value, bool):
            return value in words
        inside = low < value < high if strict else low <= value <= high
        return inside and math.isfinite(value)

    more, less = ("above", "below") if strict else ("at least", "at most")
    top = f" and {less} {high:g}" if high < math.inf else ""
    return Rule(" or ".join([f"{more} {low:g}{top}", *words]), allows)


def at_least(low: float) -> Rule:
    """Return the rule that a number must be at least `low`."""
    return within(low)


def positive() -> Rule:
    """Return the rule that a number must be above 0."""
    return within(0, strict=True)


def fraction() -> Rule:
    """Return the rule that a number must be in [0, 1]."""
    return within(0, 1)


def steps_or_fraction(zero: bool = True) -> Rule:
    """Return the rule for a number of steps, or a fraction of all steps; `zero` allows 0."""

    def allows(value: Any) -> bool:
        return 0 < value < 1 or (value >= 1 and value % 1 == 0) or (zero and value == 0)

    return Rule(f"a whole number of steps, or a fraction {'below' if zero else 'between 0 and'} 1", allows)


def seed() -> Rule:
    """Return the rule that a number must be a valid seed for torch."""
    return within(0, 2**63 - 1)


def each(rule: Rule | None = None, empty: bool = False) -> Rule:
    """Return the rule that a value must be a list of distinct items which obey another rule."""

    def allows(value: Any) -> bool:
        items = list(value)
        if not all(isinstance(item, int | float | str) for item in items):
            return False
        fits = all(rule is None or rule.allows(item) for item in items)
        return fits and len(set(items)) == len(items) and (empty or bool(items))

    what = f", each {rule.words}" if rule else ""
    return Rule(f"a list without repetitions{'' if empty else ', not empty'}{what}", allows)


def text() -> Rule:
    """Return the rule that a text must contain more than white space."""
    return Rule("text that is not empty", lambda value: bool(value.strip()))


def matching(pattern: str, words: str) -> Rule:
    """Return the rule that a text must match a regular expression; `words` describes the expression."""
    return Rule(words, lambda value: bool(re.fullmatch(pattern, value)))


def existing(kind: str, *words: str) -> Rule:
    """Return the rule that a value must be a path of an existing "file" or "folder", or one of the words."""

    def allows(value: Any) -> bool:
        path = Path(value)
        return value in words or (path.is_dir() if kind == "folder" else path.is_file())

    return Rule(" or ".join([f"an existing {kind}", *words]), allows)


def existing_clip_folders() -> Rule:
    """Return the rule that a value must be the path of an existing folder, or a list of different paths.
    `check` names a missing folder of a list."""

    def allows(value: Any) -> bool:
        if isinstance(value, str):
            return Path(value).is_dir()
        paths = list(value) if isinstance(value, Iterable) else []
        texts = all(isinstance(path, str) for path in paths)
        return bool(paths) and texts and len(set(map(Path, paths))) == len(paths)

    words = "an existing folder of npz clips, such as from memmlp data import, or a list of such folders"
    return Rule(words, allows)


DEVICE = matching(r"auto|cpu|mps|cuda(:\d+)?", "auto or cpu or cuda or cuda:INDEX or mps")


def setting(rule: Rule | None = None, default: Any = MISSING, **by_profile: Any) -> Any:
    """Declare a config key.

    The comment behind the declaration explains the key; the reference page shows this comment.

    Args:
        rule: the rule for its values; None allows every value of its type.
        default: the default value; MISSING if users must set the key.
        by_profile: several defaults. `profile.sizes` chooses one of `tiny`, `small` and `paper`;
            `profile.reading` chooses `default` or `literal`. If `width_fraction` is given and `profile.width`
            is set, the default is this fraction of the width.
    """
    metadata = {"rule": rule}
    if "literal" in by_profile:
        return field(default=_format_choice("reading", default, by_profile["literal"]), metadata=metadata)
    if by_profile:
        return field(default=sized(**by_profile), metadata=metadata)
    if isinstance(default, list | dict):
        return field(default_factory=lambda: type(default)(default), metadata=metadata)
    return field(default=default, metadata=metadata)


def sized(tiny: Any, small: Any, paper: Any, width_fraction: float = 0) -> str:
    """Return the config text that lets `profile.sizes` choose one of three values (`setting`)."""
    return _format_choice("size", tiny, small, paper, *([width_fraction] if width_fraction else []))


def tuned(lr: float, warmup: float = 0.05) -> dict[str, Any]:
    """Return the recipe of a network with the learning rate that a search found at the size `small`, and a
    warm-up (fraction of the steps). Other sizes have `profile.lr`, without a warm-up."""
    return {"optim.lr": sized("${profile.lr}", lr, "${profile.lr}"), "optim.warmup": sized(0, warmup, 0)}


def _format_choice(resolver: str, *values: Any) -> str:
    words = ("null" if value is None else str(value).lower() for value in values)
    return f"${{{resolver}:{','.join(words)}}}"


def group(kind: type, **values: Any) -> Any:
    """Declare a group of keys by a dataclass; `values` replace its defaults."""
    return field(default_factory=lambda: kind(**values))


@dataclass
class Settings:
    """The config keys of a component; the base class of all settings (`memmlp.common.components`).

    Attributes:
        name: the component's name in the config; the decorator `component` sets it.
        defaults: options that the component sets in other groups, by group; the command line wins.
        recipe: values that the component sets for other dotted keys; the command line wins.
        option: "SLOT=NAME"; the decorator sets it.
    """

    name: str = field(default=MISSING, init=False)

    defaults: ClassVar[dict[str, str | None]] = {}
    recipe: ClassVar[dict[str, Any]] = {}
    option: ClassVar[str] = ""

    @classmethod
    def problems(cls, config: Any) -> Iterator[str]:
        """Yield the reasons why the component cannot be used with a config, as lines "KEY=VALUE: must be X".

        Args:
            config: the whole config; types and rules of its keys have been checked.
        """
        yield from ()


@dataclass
class MetricSettings(Settings):
    """The properties of a custom metric; its component has the slot "metric" and builds a function.

    The function takes the prediction and the ground truth of one clip and returns one number.

    Attributes:
        unit: the unit; empty for a number without a unit.
        smallest: the smallest difference that matters, in the unit. Two methods with a smaller difference
            count as equally good.
        better: "lower" or "higher", the direction of better values.
        of: the input of the function: "positions" (N, 22, 3), metres in the world at 60 Hz, in both branches;
            "rotations" (N, 22, 3, 3), local except for the global root's, in the rotation branch.
    """

    unit: ClassVar[str] = ""
    smallest: ClassVar[float] = 0.0
    better: ClassVar[str] = "lower"
    of: ClassVar[str] = "positions"
