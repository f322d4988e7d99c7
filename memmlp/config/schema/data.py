"""The schemas of conf/data."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Optional

from memmlp.config.schema.value_rules import (
    EachOf,
    Existing,
    FolderPaths,
    OneOf,
    Text,
    Within,
    at_least,
    called,
    fraction,
    key,
    one_of,
    optional,
    positive,
    target,
    with_default,
)

# OmegaConf reads the annotations at run time and knows Optional and Union, not `|`.
# The fields' helpers make dataclass fields, not shared defaults.
# ruff: noqa: UP045, RUF009


@dataclass
class SeededSplitConfig:
    name: str = called("seeded")
    _target_: str = target("memmlp.motion.preparing.splits.SeededSplit")
    test: float = fraction()
    val: float = fraction()
    seed: int = at_least(0)
    groups: list[str] = key(EachOf(empty=True))
    groups_file: Optional[str] = optional(Existing("file"))
    train_fraction: float = with_default(1.0, Within(0, 1))
    per_group: Optional[int] = optional(Within(1))


@dataclass
class ListSplitConfig:
    name: str = called("lists")
    _target_: str = target("memmlp.motion.preparing.splits.ListSplit")
    folder: str = key(Existing("folder"))
    val: float = fraction()
    seed: int = at_least(0)
    groups: list[str] = key(EachOf(empty=True))
    groups_file: Optional[str] = optional(Existing("file"))
    train_fraction: float = with_default(1.0, Within(0, 1))


@dataclass
class SubsetSplitConfig:
    name: str = called("subsets")
    _target_: str = target("memmlp.motion.preparing.splits.SubsetSplit")
    train: list[str] = key(EachOf())
    test: list[str] = key(EachOf())
    val: float = fraction()
    seed: int = at_least(0)
    groups: list[str] = key(EachOf(empty=True))
    groups_file: Optional[str] = optional(Existing("file"))
    train_fraction: float = with_default(1.0, Within(0, 1))


@dataclass
class SynthConfig:
    minutes: float = positive()
    seed: int = at_least(0)


@dataclass
class DataConfig:
    """What all options of conf/data have in common; each adds where the motion is and how it is split."""

    name: str = key(Text())
    body: str = key(Existing("file", ("builtin",)))
    min_frames: int = at_least(2)
    strict: bool = key()
    interpolation: str = with_default("lines", OneOf(("splines", "lines")))
    drawn_by: str = one_of("frames", "clips")
    mirror: bool = with_default(False)


@dataclass
class SynthDataConfig(DataConfig):
    root: str = key(Text())
    synth: SynthConfig = field(default_factory=SynthConfig)
    split: SeededSplitConfig = field(default_factory=SeededSplitConfig)


@dataclass
class SourceConfig:
    """One of several sources of motion."""

    root: str = key(Existing("folder"))
    groups: list[str] = field(default_factory=list, metadata={"rule": EachOf(empty=True)})
    groups_file: Optional[str] = optional(Existing("file"))
    weight: Optional[float] = optional(Within(0, strict=True))
    test: Optional[float] = optional(Within(0, 1))
    val: Optional[float] = optional(Within(0, 1))


@dataclass
class SeededDataConfig(DataConfig):
    root: Any = key(FolderPaths())
    sources: dict[str, SourceConfig] = field(default_factory=dict)
    synth: Optional[SynthConfig] = None
    split: SeededSplitConfig = field(default_factory=SeededSplitConfig)


@dataclass
class ListDataConfig(DataConfig):
    root: str = key(Existing("folder"))
    synth: Optional[SynthConfig] = None
    partial: bool = False
    split: ListSplitConfig = field(default_factory=ListSplitConfig)


@dataclass
class SubsetDataConfig(DataConfig):
    root: str = key(Existing("folder"))
    synth: Optional[SynthConfig] = None
    partial: bool = False
    split: SubsetSplitConfig = field(default_factory=SubsetSplitConfig)
