"""Wording helpers for flags: which property differs, and between which variants."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence


def flags_of_difference(what: str, found: Iterable[tuple[str, str]]) -> Iterable[str]:
    """Flag a property in which variants differ, and name the variants that have each value.

    `found` has pairs of a value and a variant's label.
    """
    groups: dict[str, list[str]] = defaultdict(list)
    for value, label in found:
        groups[value].append(label)
    if len(groups) > 1:
        parts = [f"{value} of {quoted(labels)}" for value, labels in groups.items()]
        yield f"{what} differs: {'; '.join(parts)}"


def unique(words: Iterable[str]) -> list[str]:
    """Return words without repetitions, in their order."""
    return list(dict.fromkeys(words))


def quoted(labels: Iterable[str]) -> str:
    """Return labels in quotes, each once, joined with commas (`listed`)."""
    return listed([f"'{label}'" for label in unique(labels)])


def had_core(label: str, share: float) -> str:
    """Name what was timed while its thread had a core for only a share of the time."""
    return f"'{label}' (had a core for {100 * share:.0f} % of the time)"


def listed(words: Sequence[str], most: int = 12) -> str:
    """Join words with commas; of many words, only the first ones and the number of the others."""
    return ", ".join(words[:most]) + (f", and {len(words) - most} more" if len(words) > most else "")
