"""An override of a config, such as `optim.lr=1e-3` or `+term=mine`, parsed once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from memmlp.common.progress import notify

SIGNS = "+~"
"""The signs at the start of an override: + and ++ add a key, ~ removes a key."""


@dataclass(frozen=True)
class Override:
    """An override [SIGNS]KEY[=VALUE] from a command line: the whole text, the signs ("", "+", "++" or "~"), a
    dotted key or a config group, and the text after the first "=", None without one."""

    text: str
    signs: str
    key: str
    value: str | None

    @classmethod
    def parse(cls, text: str) -> Override:
        """Split an override's text. Every text is accepted; Hydra checks it later."""
        left, equals, value = text.partition("=")
        key = left.lstrip(SIGNS)
        return cls(text, left[: len(left) - len(key)], key, value if equals else None)

    @property
    def group(self) -> str:
        """The first part of the key: `optim` of `optim.lr`."""
        return self.key.partition(".")[0]

    @property
    def options(self) -> list[str]:
        """The options in an override of a group: one, several for a list [A,B], none for null."""
        names = [name.strip(" '\"") for name in (self.value or "").strip("[] ").split(",")]
        return [name for name in names if name not in ("", "null")]

    def __str__(self) -> str:
        return self.text


def parse_overrides(texts: Iterable[str]) -> list[Override]:
    """Parse several overrides."""
    return [Override.parse(text) for text in texts]


def notify_repeats(texts: Iterable[str]) -> None:
    """Tell the user which overrides of a command line replace earlier ones of the same key."""
    last: dict[str, str] = {}
    for one in parse_overrides(texts):
        if one.signs != "~" and (before := last.get(one.key, one.text)) != one.text:
            notify(f"{one.text} replaces {before}")
        last[one.key] = one.text


def select_last_by_key(texts: Iterable[str]) -> dict[str, Override]:
    """Return the last override of each key, in the order in which the keys first appear."""
    return {override.key: override for override in parse_overrides(texts)}


def format_value(value: Any) -> str:
    """Return a value as the text to use in an override."""
    if isinstance(value, list):
        return f"[{','.join(map(format_value, value))}]"
    if value is None:
        return "null"
    return str(value).lower() if isinstance(value, bool) else str(value)


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Convert a nested mapping to a flat one with dotted keys; lists are not changed."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping) and value:
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat
