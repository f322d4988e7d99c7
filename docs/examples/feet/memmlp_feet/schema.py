"""The keys of this package's options, typed and with their limits."""

from __future__ import annotations

from dataclasses import dataclass

from memmlp.config.schema.network import MemoryConfig
from memmlp.config.schema.value_rules import EachOf, Within, at_least, called, key, one_of, target

# ruff: noqa: RUF009


@dataclass
class MeanMemoryConfig(MemoryConfig):
    """memory=mean."""

    name: str = called("mean")
    _target_: str = target("memmlp_feet.memory.MeanMemory")
    layers: list[int] = key(EachOf(Within(1)))
    width: int = at_least(1)
    fusion: str = one_of("residual", "plain")
