"""A split by person: who is in validation or test has no clip in training."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from memmlp.common.errors import InputError
from memmlp.motion.preparing.splits import Assignment, Split, rank


@dataclass(frozen=True)
class Kind:
    """Persons with the same kind of motion.

    Attributes:
        persons: their ids.
        test: how many of them are for test.
        val: how many of them are for validation.
    """

    persons: Sequence[str]
    test: int
    val: int


@dataclass(frozen=True)
class PersonSplit(Split):
    """A split by person, balanced over kinds of motion. A person is a group.

    The persons of each kind are sorted by a hash of seed and id. The first are for test, the next for
    validation and the others for training, like everybody who is in no kind.

    Args:
        persons: pattern of clips' names -> the id of the person in these clips, in which `\\1` stands for the
            pattern's first group; None leaves the clips out. The first pattern that matches counts.
        kinds: kind of motion -> its persons; a person has one kind.
        seed: seed of the order.

    Raises:
        InputError: for an invalid pattern or id, a person of two kinds, or a kind with too few persons.
    """

    persons: Mapping[str, str | None]
    kinds: Mapping[str, Kind]
    seed: int = 0
    groups_digest: str | None = None

    def __post_init__(self) -> None:
        for pattern, person in self.persons.items():
            try:
                re.compile(f"{pattern}|").search("").expand(person or "")  # type: ignore[union-attr]
            except (re.error, IndexError) as error:
                raise InputError(
                    f"data.split.persons={pattern!r}: {error}; must be a pattern and an id"
                ) from error
        every = [person for kind in self.kinds.values() for person in kind.persons]
        if twice := sorted({person for person in every if every.count(person) > 1}):
            raise InputError(f"data.split.kinds: {twice[0]} has two kinds; must have one")
        for name, kind in self.kinds.items():
            if kind.test + kind.val > len(kind.persons):
                few = f"{len(kind.persons)} persons for {kind.test} in test and {kind.val} in validation"
                raise InputError(f"data.split.kinds.{name}: {few}; must have at least as many")

    @property
    def parts(self) -> dict[str, str]:
        """The part of each person who has a kind."""
        found: dict[str, str] = {}
        for kind in self.kinds.values():
            order = sorted(kind.persons, key=lambda person: rank(person, self.seed))
            counts = {"test": kind.test, "val": kind.val, "train": len(order)}
            parts = [part for part, count in counts.items() for _ in range(count)]
            found |= dict(zip(order, parts, strict=False))
        return found

    def assign(self, names: Sequence[str]) -> Assignment:
        parts = self.parts
        persons = {name: self.identify(name) for name in names}
        return Assignment(
            {name: parts.get(person, "train") if person else None for name, person in persons.items()},
            {name: person or name for name, person in persons.items()},
        )

    def identify(self, name: str) -> str | None:
        """Return the id of the person in a clip; None for a clip that is left out.

        Raises:
            InputError: if the clip matches no pattern.
        """
        for pattern, person in self.persons.items():
            if match := re.search(pattern, name):
                return person and match.expand(person)
        raise InputError(
            f"data.split.persons: no pattern matches {name}; must have one with the person's id, "
            "or with null to leave the clip out"
        )

    @property
    def listed(self) -> Mapping[str, int]:  # type: ignore[override]
        """The number of persons of each kind."""
        return {name: len(kind.persons) for name, kind in self.kinds.items()}

    def missing(self, names: Collection[str]) -> tuple[str, ...]:
        present = set(map(self.identify, names))
        persons = [(name, person) for name, kind in self.kinds.items() for person in kind.persons]
        return tuple(f"{name}/{person}" for name, person in persons if person not in present)

    def check_groups(self, names: Collection[str], files: Collection[str]) -> None:
        """Do nothing: there is no column file."""

    def describe(self) -> dict[str, Any]:
        kinds = {name: asdict(kind) for name, kind in self.kinds.items()}
        return {"kind": "persons", "seed": self.seed, "persons": [*self.persons.items()], "kinds": kinds}
