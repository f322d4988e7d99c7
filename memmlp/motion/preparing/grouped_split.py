"""The assignment of groups of clips to parts, which all splits share (`memmlp.motion.preparing.splits`).

Fractions count groups, and a clip that nothing ties to another is a group of its own. Nothing depends on the
order of the names: groups are ranked by a hash of seed and name, so a clip that is added later moves few
others, and a smaller `train_fraction` takes some of the clips of a larger one.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.motion.preparing.groups import Grouping


class Grouped:
    """A split that divides groups of clips in a seeded order; the base of all such splits."""

    groups: Sequence[str]
    groups_file: Path | str | None
    val: float
    seed: int
    train_fraction: float

    @cached_property
    def grouping(self) -> Grouping:
        """The rules that tie clips together."""
        return Grouping.of(self.groups, self.groups_file)

    @property
    def groups_digest(self) -> str | None:
        return self.grouping.digest

    def limited(self, parts: Mapping[str, str | None], groups: Mapping[str, str]) -> dict[str, str | None]:
        return dict(parts)

    def check_groups(self, names: Collection[str], files: Collection[str]) -> None:
        self.grouping.check(names, files)

    def described(self) -> dict[str, Any]:
        """Return the part of `Split.describe` that all such splits share."""
        digest = self.groups_digest
        file = {"groups_file_sha256": digest} if digest else {}
        fewer = {"train_fraction": self.train_fraction} if self.train_fraction < 1 else {}
        return {"val": self.val, "seed": self.seed, "groups": list(self.groups), **file, **fewer}

    def divided(self, seen: Mapping[str, str], fractions: Mapping[str, float]) -> dict[str, str | None]:
        """Map clips to parts: the first groups in seeded order fill those of `fractions`, the others train.

        The last groups of train are left out (None), as `train_fraction` says.

        Args:
            seen: each clip's name -> the name that patterns and the seeded order use.
            fractions: part -> its fraction of the groups.

        Raises:
            InputError: if there are fewer groups than parts.
        """
        ranked = sorted(self.grouping.tied(seen), key=lambda group: rank(seen[group[0]], self.seed))
        parts: dict[str, str | None] = dict.fromkeys(seen, "train")
        start = 0
        for part, count in _counts(len(ranked), fractions).items():
            for group in ranked[start : start + count]:
                parts.update(dict.fromkeys(group, part))
            start += count
        used = max(1, round(self.train_fraction * (len(ranked) - start)))
        for group in ranked[start + used :]:
            parts.update(dict.fromkeys(group, None))
        return parts


def check_fractions(train_fraction: float, **fractions: float) -> None:
    """Raise InputError, naming the key, for fractions that are out of range or leave nothing for train."""
    if not 0 < train_fraction <= 1:
        raise InputError(
            f"data.split.train_fraction: {train_fraction} is none; allowed is above 0 and at most 1"
        )
    for key, value in fractions.items():
        if not 0 <= value < 1:
            raise InputError(f"data.{key}: {value} is no fraction; allowed: 0 <= {key} < 1")
    if sum(fractions.values()) >= 1:
        raise InputError(f"data.{', data.'.join(fractions)}: they add up to 1 or more; leave some to train")


def rank(name: str, seed: int) -> str:
    """Return the key by which names are sorted for an order that depends on the seed alone."""
    return hashlib.sha256(json.dumps([seed, name]).encode()).hexdigest()


def _counts(total: int, fractions: Mapping[str, float]) -> dict[str, int]:
    """Return how many groups each part gets, leaving one for train.

    That is its rounded share: none for a fraction of 0, otherwise at least one.
    """
    counts = {part: max(1, round(share * total)) if share > 0 else 0 for part, share in fractions.items()}
    needed = 1 + sum(count > 0 for count in counts.values())
    if total < needed:
        wanted = ", ".join(["train", *(part for part, count in counts.items() if count)])
        raise InputError(
            f"data.split: {wanted} need at least {needed} clips or groups, and there are {total}; "
            "add clips, loosen data.split.groups or set a fraction to 0"
        )
    while sum(counts.values()) >= total:
        counts[max(counts, key=lambda part: counts[part])] -= 1
    return counts
