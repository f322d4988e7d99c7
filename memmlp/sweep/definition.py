"""What a sweep is: arms, seeds, the overrides that train each arm (files: memmlp.sweep.sweep_file)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.overrides import Override
from memmlp.evaluation.metric_facts import SMALLEST

MODES = ("stream", "window")
BRANCHES = ("rotation", "position", "combined")
SIZES = ("FLOPs", "MACs", "parameters", "size")
"""The costs that a network has before it is trained, on any machine."""
TIMES = ("ms", "network ms", "pose ms", "ratio", "FPS")
"""The costs that are measured in time, and so differ a little each time, even with nothing else at work."""
COSTS = (*SIZES, *TIMES)
"""Metrics that are costs, not errors.

Their units: GFLOP, GMAC, millions, MB, ms, multiples of the yardstick's time, and frames per second.
"""


@dataclass(frozen=True)
class Arm:
    """A row of a table.

    Attributes:
        label: the arm's name in the table.
        overrides: the arm's overrides of the base; None if the row has only the paper's values (a system that
            is not built here).
        branch: whose errors the row shows: rotation, position, or combined (after inverse kinematics).
        paper: the paper's values by metric, as printed.
        note: a remark shown under the table.
        against: the label of the arm that this one is compared with; None for the sweep's control.
        fixed: whether the file gives the arm a branch of its own.
        seeds: the arm's own seeds, if seeds are added only to arms with open verdicts; None for the sweep's.
        series: the arm's label in the file, which is the same in all cells of the axes.
        cell: the overrides that the axes add, one per key; empty without axes.
    """

    label: str
    overrides: tuple[str, ...] | None = ()
    branch: str = "rotation"
    paper: Mapping[str, float] | None = None
    note: str | None = None
    against: str | None = None
    fixed: bool = False
    seeds: tuple[int, ...] | None = None
    series: str = ""
    cell: tuple[str, ...] = ()

    @property
    def own_overrides(self) -> tuple[str, ...]:
        """The arm's overrides without those of its cell."""
        return tuple(word for word in self.overrides or () if word not in self.cell)


@dataclass(frozen=True)
class ArmSeed:
    """One training: an arm with a seed, as overrides of `memmlp train`."""

    label: str
    seed: int
    overrides: tuple[str, ...]


@dataclass(frozen=True)
class Sweep:
    """A sweep file, or one with overrides added on the command line.

    Attributes:
        name: the file's stem.
        title: the table's title.
        table: the table's number in the paper; None for a custom sweep.
        notes: remarks shown under the table.
        base: overrides that all arms share.
        seeds: the seeds of each arm.
        arms: the rows in order.
        control: the label of the arm with which the others are compared.
        metrics: the columns.
        command_line: overrides given on the command line.
        branch_source: how we know which branch the paper's values belong to; None if the file does not say.
        smallest: the smallest effect of interest by metric, in its unit; every metric but costs has one.
    """

    name: str
    title: str
    table: int | None
    notes: tuple[str, ...]
    base: tuple[str, ...]
    seeds: tuple[int, ...]
    arms: tuple[Arm, ...]
    control: str
    metrics: tuple[str, ...]
    command_line: tuple[str, ...] = ()
    branch_source: str | None = None
    smallest: Mapping[str, float] = field(default_factory=lambda: SMALLEST)

    def with_branch(self, branch: str) -> Sweep:
        """Return the same sweep with its arms showing another branch.

        An arm with a branch of its own in the file keeps it. The paper's values belong to the branch for
        which they were printed, so arms whose branch changes lose them.

        Raises:
            InputError: for an unknown branch.
        """
        name = parse_branch(branch, "branch")
        arms = tuple(
            arm if arm.fixed or arm.branch == name else replace(arm, branch=name, paper={})
            for arm in self.arms
        )
        return self if arms == self.arms else replace(self, arms=arms, branch_source=None)

    def control_of(self, arm: Arm) -> str | None:
        """Return the label of an arm's control arm: the arm's own `against`, or else the sweep's control.

        It is None for the sweep's control itself, unless that arm has an `against`, too.
        """
        return arm.against or (self.control if arm.label != self.control else None)

    def seeds_of(self, arm: Arm) -> tuple[int, ...]:
        """Return the seeds of an arm: its own if it has any, else the sweep's."""
        return self.seeds if arm.seeds is None else arm.seeds

    def with_overrides(self, overrides: Sequence[str]) -> Sweep:
        """Return the same sweep with further overrides, applied after its base and before the arms' own.

        `seed=0,1` or `seed=0` sets the seeds.

        Raises:
            InputError: for an override of the outputs folder, which an option of the command sets, and for a
                key that an arm sets itself, since the arm's value would win.
        """
        if any(key_of(word) == "paths.outputs" for word in overrides):
            raise InputError("paths.outputs: allowed here is --outputs FOLDER, or MEMMLP_OUTPUTS")
        if any(key_of(word) == "save_predictions" for word in overrides):
            raise InputError(
                "save_predictions: a sweep's runs would write over each other's; allowed is memmlp eval RUN "
                "--save-predictions FOLDER"
            )
        seeds = [one.value or "" for one in map(Override.parse, overrides) if one.key == "seed"]
        others = tuple(word for word in overrides if key_of(word) != "seed")
        self._check_keys_of_arms(others)
        chosen = parse_seeds(seeds[-1].split(","), "seed") if seeds else self.seeds
        return replace(self, command_line=(*self.command_line, *others), seeds=chosen)

    def _check_keys_of_arms(self, overrides: Iterable[str]) -> None:
        """Raise InputError for an override of a key that an arm sets itself."""
        setters = {key_of(word): arm.label for arm in self.runnable() for word in arm.overrides or ()}
        for word in overrides:
            if (key := key_of(word)) in setters:
                raise InputError(
                    f"{word}: arm '{setters[key]}' of sweep {self.name} sets {key} itself; "
                    "allowed are keys that no arm sets"
                )

    def all_overrides(self, arm: Arm) -> tuple[str, ...]:
        """Return an arm's overrides: the base's, the command line's, its own; the last one of a key wins."""
        words = (*self.base, *self.command_line, *(arm.overrides or ()))
        return tuple({key_of(word): word for word in words}.values())

    def runnable(self) -> tuple[Arm, ...]:
        """Return the arms that can be run: all except those with only the paper's values."""
        return tuple(arm for arm in self.arms if arm.overrides is not None)

    def labels_of(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return the labels of the arms that are named, of all that can be run if none is.

        Raises:
            InputError: for a name that no arm has, or an arm with only the paper's values.
        """
        known = [arm.label for arm in self.runnable()]
        if missing := [name for name in names if name not in known]:
            raise InputError(
                f"sweep {self.name}: no arm '{missing[0]}' that can be run; allowed are {', '.join(known)}"
            )
        return tuple(names) or tuple(known)

    def arm_seeds(self) -> list[ArmSeed]:
        """Return the trainings that the sweep needs, arm by arm."""
        return [
            ArmSeed(arm.label, seed, (*self.all_overrides(arm), f"seed={seed}"))
            for arm in self.runnable()
            for seed in self.seeds_of(arm)
        ]


def key_of(override: str) -> str:
    """Return the key or group that an override sets, adds (+) or removes (~)."""
    return Override.parse(override).key


def parse_branch(value: Any, name: str) -> str:
    """Return the name of a branch. Raises InputError, naming the key, for an unknown one."""
    if value not in BRANCHES:
        raise InputError(f"{name}: '{value}'; allowed are {', '.join(BRANCHES)}")
    return value


def parse_seeds(value: Any, name: str) -> tuple[int, ...]:
    """Return the seeds, after a check that they are different whole numbers."""
    if not isinstance(value, list):  # a number may be meant as how many
        raise InputError(f"{name}: {value}; allowed is a list of whole numbers, each once, such as [0, 1, 2]")
    words = [str(item).strip() for item in value]
    if not words or not all(re.fullmatch(r"\d+", word) for word in words) or len(set(words)) < len(words):
        raise InputError(f"{name}: {value}; allowed is a list of whole numbers, each once")
    return tuple(map(int, words))
