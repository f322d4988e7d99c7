"""What a user's package declares about its components: options of slots, metrics, recipe versions."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

BETTER = ("lower", "higher")
MEASURED = ("positions", "rotations")


@dataclass(frozen=True)
class Metric:
    """A custom metric, measured on test clips if `evaluation.metrics` names it.

    Attributes:
        function: the dotted path of a function of the prediction and the truth of one clip, which returns one
            number; nothing is imported before it is needed.
        unit: the unit; empty for a number without one.
        smallest: the smallest difference that matters, in the unit: two methods may differ by this much and
            still count as equally good.
        better: which values are better, "lower" or "higher".
        of: what the function gets: "positions" (N, 22, 3), metres in the world at 60 Hz, in both branches, or
            "rotations" (N, 22, 3, 3), local except for the root's, which is global, in the rotation branch.
        recipe: the recipe version, to be raised when the function's results change.
    """

    function: str
    unit: str
    smallest: float
    better: str = "lower"
    of: str = "positions"
    recipe: int = 1


@dataclass(frozen=True)
class Plugin:
    """What a user's package adds, given in an attribute `plugin` of its module.

    A package without this attribute adds nothing, but configs may name its classes.

    Attributes:
        conf: the folder of configs inside the package, whose options are offered beside memmlp's; it need not
            exist.
        schemas: the dotted path of the dataclass with an option's keys, by the option's name with its group:
            "memory_mean". An option without one has the keys of its slot.
        recipes: recipe versions of components, such as {"memory.mean": 2}, to be raised when a component's
            results change, so that its runs are made again.
        metrics: custom metrics by name, which is one word.
    """

    conf: str = "conf"
    schemas: Mapping[str, str] = field(default_factory=dict)
    recipes: Mapping[str, int] = field(default_factory=dict)
    metrics: Mapping[str, Metric] = field(default_factory=dict)


METRICS: dict[str, Metric] = {}
"""The metrics of all packages in use, by name (memmlp.config.plugins fills it)."""


def faults(plugin: Plugin) -> Iterator[str]:
    """Yield what is wrong with a package's declarations, one line each."""
    for name, metric in plugin.metrics.items():
        if not re.fullmatch(r"[A-Za-z]\w*", name):
            yield f"metric '{name}': allowed is a word of letters, digits and _"
        if metric.better not in BETTER:
            yield f"metric {name}: better={metric.better}; allowed is {' or '.join(BETTER)}"
        if metric.of not in MEASURED:
            yield f"metric {name}: of={metric.of}; allowed is {' or '.join(MEASURED)}"
        if not 0 < metric.smallest < math.inf:
            yield f"metric {name}: smallest={metric.smallest}; allowed is a number above 0"
    numbers = {**plugin.recipes, **{f"metric.{name}": one.recipe for name, one in plugin.metrics.items()}}
    for name, number in numbers.items():
        if not isinstance(number, int) or isinstance(number, bool) or number < 1:
            yield f"recipe of {name}: {number}; allowed is a whole number of at least 1"
