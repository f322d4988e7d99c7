"""How many of a split's entries have clips, so that a part of a protocol never passes for the whole."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from memmlp.common.errors import InputError
from memmlp.motion.preparing.several_folders import Root


@dataclass(frozen=True)
class Coverage:
    """How many entries of a split (list entries, subsets) have a clip.

    Attributes:
        listed: number of entries by subset; empty for a split that divides all clips in the folder.
        absent: number of entries without a clip by subset; complete subsets are left out.
    """

    listed: Mapping[str, int]
    absent: Mapping[str, int]

    @classmethod
    def of(cls, listed: Mapping[str, int], absent: Iterable[str]) -> Coverage:
        """Return the coverage of a split, given its entries without a clip."""
        return cls(listed, dict(Counter(entry.split("/")[0] for entry in sorted(absent))))

    @property
    def whole(self) -> bool:
        """Whether every entry has a clip."""
        return not self.absent

    @property
    def counts(self) -> tuple[int, int]:
        """The number of entries that have a clip, and the number of all entries."""
        every = sum(self.listed.values())
        return every - sum(self.absent.values()), every

    def __str__(self) -> str:
        there, every = self.counts
        return f"{100 * there // max(every, 1)} % of the list ({there} of {every} entries)"

    @property
    def gaps(self) -> str:
        """The missing entries in words: how many in all, and how many of each subset."""
        there, every = self.counts
        each = [f"{name} {count} of {self.listed[name]}" for name, count in self.absent.items()]
        return f"{every - there} of {every} entries of the split's list have no clip ({', '.join(each)})"

    def check(self, root: Root) -> None:
        """Check that every entry has a clip below the data's root. Raises InputError if one has none."""
        if not self.whole:
            raise InputError(
                f"data.root: {self.gaps} below {root}; data.partial=true takes the part there is"
            )
