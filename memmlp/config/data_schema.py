"""The keys of conf/data."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from memmlp.common.settings import (
    Settings,
    at_least,
    clip_folders,
    each,
    existing,
    fraction,
    group,
    one_of,
    positive,
    setting,
    text,
)


@dataclass
class SplitConfig:
    """What all splits have in common."""

    name: str = setting(text())  # seeded, lists or subsets
    val: float = setting(fraction())
    seed: int = setting(at_least(0), 0)
    groups: list[str] = setting(each(empty=True))
    groups_file: str | None = setting(existing("file"), None)
    train_fraction: float = setting(fraction(), 1.0)


@dataclass
class SeededSplitConfig(SplitConfig):
    name: str = setting(one_of("seeded"), "seeded")
    test: float = setting(fraction())
    per_group: int | None = setting(at_least(1), None)


@dataclass
class ListSplitConfig(SplitConfig):
    name: str = setting(one_of("lists"), "lists")
    folder: str = setting(existing("folder"))


@dataclass
class SubsetSplitConfig(SplitConfig):
    name: str = setting(one_of("subsets"), "subsets")
    train: list[str] = setting(each())
    test: list[str] = setting(each())


@dataclass
class KindConfig:
    """Persons with the same kind of motion, and how many of them are held out."""

    persons: list[str] = setting(each())
    test: int = setting(at_least(0))
    val: int = setting(at_least(0))


@dataclass
class PersonSplitConfig:
    """A split by person."""

    name: str = setting(one_of("persons"), "persons")
    persons: dict[str, str | None] = field(default_factory=dict)
    kinds: dict[str, KindConfig] = field(default_factory=dict)
    seed: int = setting(at_least(0), 0)


@dataclass
class DataConfig:
    """What all options of conf/data have in common; each adds where the motion is and how it is split."""

    name: str = setting(text())
    body: str = setting(existing("file", "builtin"))
    min_frames: int = setting(at_least(2))
    strict: bool = setting()
    interpolation: str = setting(one_of("splines", "lines"), "lines")
    drawn_by: str = setting(one_of("frames", "clips"))
    mirror: bool = setting(default=False)


@dataclass
class SynthDataConfig(DataConfig):
    root: str = setting(text())
    synth: Settings | None = None  # a generator
    split: SeededSplitConfig = group(SeededSplitConfig)


@dataclass
class SourceConfig:
    """One of several sources of motion."""

    root: str = setting(existing("folder"))
    groups: list[str] = setting(each(empty=True), [])
    groups_file: str | None = setting(existing("file"), None)
    weight: float | None = setting(positive(), None)
    test: float | None = setting(fraction(), None)
    val: float | None = setting(fraction(), None)


@dataclass
class SeededDataConfig(DataConfig):
    root: Any = setting(clip_folders())
    sources: dict[str, SourceConfig] = field(default_factory=dict)
    synth: Settings | None = None
    split: SeededSplitConfig = group(SeededSplitConfig)


@dataclass
class ListDataConfig(DataConfig):
    root: str = setting(existing("folder"))
    synth: Settings | None = None
    partial: bool = False
    split: ListSplitConfig = group(ListSplitConfig)


@dataclass
class SubsetDataConfig(DataConfig):
    root: str = setting(existing("folder"))
    synth: Settings | None = None
    partial: bool = False
    split: SubsetSplitConfig = group(SubsetSplitConfig)


@dataclass
class PersonDataConfig(DataConfig):
    root: str = setting(existing("folder"))
    synth: Settings | None = None
    partial: bool = False
    split: PersonSplitConfig = group(PersonSplitConfig)
