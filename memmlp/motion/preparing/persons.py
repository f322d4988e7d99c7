"""A split by person: training has no clips of the persons in validation or test."""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from memmlp.common.errors import InputError
from memmlp.motion.preparing.splits import Assignment, Split, make_sort_key


@dataclass(frozen=True)
class Kind:
    """A kind of motion: the ids of its persons, and how many of them are in test and in validation."""

    persons: Sequence[str]
    test: int
    val: int


@dataclass(frozen=True)
class PersonSplit(Split):
    """A split by person, balanced over kinds of motion. The clips of a person are a group. The persons of
    each kind are sorted by a hash of seed and id. The first persons are in test, the next in validation, and
    all others in training. Persons without a kind are in training too.

    `persons` maps patterns for clip names to ids of persons; the first matching pattern applies. `\\1` in an
    id is the pattern's first captured group; None leaves the clips out. `kinds` maps names of kinds of motion
    to their persons. Raises InputError for an invalid pattern or id, a person with two kinds, or a kind with
    too few persons."""

    persons: Mapping[str, str | None]
    kinds: Mapping[str, Kind]
    seed: int = 0
    groups_digest: str | None = None

    def __post_init__(self) -> None:
        for pattern, person in self.persons.items():
            try:
                re.compile(f"{pattern}|").search("").expand(person or "")  # type: ignore[union-attr]
            except (re.error, IndexError) as error:
                expected = "must map a valid pattern to a valid id"
                raise InputError(f"data.split.persons={pattern!r}: {error}; {expected}") from error
        every = [person for kind in self.kinds.values() for person in kind.persons]
        if twice := sorted({person for person in every if every.count(person) > 1}):
            raise InputError(f"data.split.kinds: {twice[0]} has two kinds; a person must have only one kind")
        for name, kind in self.kinds.items():
            count = kind.test + kind.val
            if count > len(kind.persons):
                needed = f"{count} persons or more ({kind.test} for test, {kind.val} for validation)"
                raise InputError(f"data.split.kinds.{name}: must have {needed}, not {len(kind.persons)}")

    @property
    def parts(self) -> dict[str, str]:
        part_of: dict[str, str] = {}
        for kind in self.kinds.values():
            order = sorted(kind.persons, key=lambda person: make_sort_key(person, self.seed))
            counts = {"test": kind.test, "val": kind.val, "train": len(order)}
            parts = [part for part, count in counts.items() for _ in range(count)]
            part_of |= dict(zip(order, parts, strict=False))
        return part_of

    def assign(self, names: Sequence[str]) -> Assignment:
        parts = self.parts
        persons = {name: self.identify_person(name) for name in names}
        return Assignment(
            {name: parts.get(person, "train") if person else None for name, person in persons.items()},
            {name: person or name for name, person in persons.items()},
        )

    def identify_person(self, name: str) -> str | None:
        """Return the id of the person in a clip; None if the clip is left out. Raises InputError if the clip
        matches no pattern."""
        for pattern, person in self.persons.items():
            if match := re.search(pattern, name):
                return person and match.expand(person)
        advice = "add a pattern with the person's id, or with null to leave the clip out"
        raise InputError(f"data.split.persons: no pattern matches {name}; {advice}")

    @property
    def entry_counts(self) -> Mapping[str, int]:  # type: ignore[override]
        """Subset -> number of the split's entries."""
        return {name: len(kind.persons) for name, kind in self.kinds.items()}

    def find_missing_entries(self, names: Collection[str]) -> tuple[str, ...]:
        present = set(map(self.identify_person, names))
        persons = [(name, person) for name, kind in self.kinds.items() for person in kind.persons]
        return tuple(f"{name}/{person}" for name, person in persons if person not in present)

    def describe(self) -> dict[str, Any]:
        kinds = {name: asdict(kind) for name, kind in self.kinds.items()}
        return {"kind": "persons", "seed": self.seed, "persons": [*self.persons.items()], "kinds": kinds}
