"""Search files: the ranges of config keys, the objectives, the number of trials, and the sampler.

name: loss_weights
base: [loss=manual]                 # overrides of every trial
space:                              # a tree of config keys; its leaves are ranges
  loss:
    rotation_all: {low: 0.1, high: 10.0, log: true, first: 1.0}
  optim:
    batch: {low: 16, high: 64, step: 16}
  hand: {choices: [default, 'off']} # default: no override; a choice may go on with further overrides
objectives: [MPJPE]                 # validation metrics to minimise; [MPJPE, Jitter] gives a Pareto front
n_trials: 30                        # the total number of trials, also if the search is restarted
seeds: 1                            # the number of runs per trial; the objective is their mean
sampler: tpe                        # tpe; random; grid: each combination of choices once
startup: 10                         # the number of random trials before TPE; null for other samplers
seed: 0                             # the sampler's seed
pruner: median                      # median: stops a trial worse than the median of earlier trials; none
prune_after: 5                      # the number of finished trials before pruning; null with pruner: none
tflop: null                         # training compute of each run, TFLOP; null: optim.steps sets the length
after: null                         # the folder of an earlier search; its best trial is the base of all
                                    # trials, and {factor: 3} ranges from its value / 3 to its value * 3
storage: null                       # null: a journal in the search's folder; or a storage URL for Optuna
"""

import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.overrides import format_value
from memmlp.common.schema import parse_config_yaml
from memmlp.common.settings import Rule, matching, one_of, positive
from memmlp.common.text_formats import parse_csv
from memmlp.evaluation.metric_facts import HIGHER, UNITS
from memmlp.runs import records
from memmlp.runs.records import SearchRecord

OBJECTIVE_BRANCHES = ("rotation", "position")
RANGE_KEYS = ("low", "high", "log", "step", "choices", "first", "factor")
DEFAULT = "default"  # the choice that leaves a key unchanged

Value = float | int | str | bool | None


@dataclass(frozen=True)
class Range:
    """The values that a search may give to one config key: one of `choices`, or between `low` and `high`,
    inclusive. If both are whole numbers, only whole numbers are tried. With `log`, the logarithm of the
    values is sampled uniformly. `step` is that of a grid that starts at `low`. The sampler chooses the value
    in the first trial if `first` is None."""

    key: str
    low: float | int = 0
    high: float | int = 0
    log: bool = False
    step: float | int | None = None
    choices: tuple[Value, ...] = ()
    first: Value | None = None

    def allows(self, value: Any) -> bool:
        if self.choices:
            return value in self.choices
        return isinstance(value, int | float) and self.low <= value <= self.high

    def list_corners(self) -> tuple[Value, ...]:
        """Return all choices, or both limits of the range."""
        return self.choices or (self.low, self.high)


@dataclass(frozen=True)
class Objective:
    """A weighted sum of validation metrics, which the search minimises: its text in the search file, and
    pairs of a weight and a metric's name in the metrics log ("rotation MPJPE")."""

    text: str
    terms: tuple[tuple[float, str], ...]

    def value(self, metrics: Mapping[str, float]) -> float:
        """Return the objective's value for a validation's metrics. Raises InputError for a missing metric."""
        for _, name in self.terms:
            if name not in metrics:
                known = ", ".join(metrics)
                raise InputError(f"search.objectives: '{name}' is not validated; expected one of {known}")
        return sum(weight * metrics[name] for weight, name in self.terms)


@dataclass(frozen=True)
class Search:
    """A checked search; its fields are the keys of the config group `search` (see the module's docstring)."""

    name: str
    base: tuple[str, ...]
    space: tuple[Range, ...]
    objectives: tuple[Objective, ...]
    n_trials: int
    seeds: int
    sampler: str
    startup: int | None
    seed: int
    pruner: str
    prune_after: int | None
    tflop: float | None
    after: str | None
    storage: str | None

    def list_first_trials(self) -> list[dict[str, Value]]:
        """Return the values by key of the trials that are not the sampler's: a trial with the values in
        `first`, or all combinations of a grid."""
        if self.sampler == "grid":
            keys = [one.key for one in self.space]
            every = itertools.product(*(one.choices for one in self.space))
            return [dict(zip(keys, values, strict=True)) for values in every]
        first: dict[str, Value] = {one.key: one.first for one in self.space if one.first is not None}
        return [first] if first else []

    @property
    def budget(self) -> tuple[str, ...]:
        """The overrides of a fixed compute; the weights of the best of five validations are kept."""
        if self.tflop is None:
            return ()
        branch = self.objectives[0].terms[0][1].split()[0]
        validation = "optim.validate_every=0.2", "optim.validation_pieces=32"
        untested = "evaluation.modes=[]"  # test clips are for the chosen network
        return untested, f"optim.tflop={self.tflop}", f"optim.best_by={branch}", *validation

    @staticmethod
    def overrides(values: Mapping[str, Value]) -> tuple[str, ...]:
        """Return a trial's values as overrides of `memmlp train`."""
        texts: list[str] = []
        for key, value in values.items():
            if isinstance(value, str) and " " in value:
                texts += f"{key}={value}".split()
            elif value != DEFAULT:
                texts.append(f"{key}={format_value(value)}")
        return tuple(texts)


def _make_whole_number_rule(least: int) -> Rule:
    return Rule(f"a whole number of at least {least}", lambda value: type(value) is int and value >= least)


def _is_text_list(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, str) for item in value)


RULES = {
    "name": matching(r"[\w-]{1,64}", "up to 64 letters, digits, - and _"),
    "tflop": Rule("above 0, or null", lambda value: value is None or positive().allows(value)),
    "after": Rule("a folder, or null", lambda value: value is None or isinstance(value, str)),
    "storage": Rule("a URL, or null", lambda value: value is None or isinstance(value, str)),
    "objectives": Rule("a list of texts", _is_text_list),
    "base": Rule("a list of texts", _is_text_list),
    "n_trials": _make_whole_number_rule(1),
    "seeds": _make_whole_number_rule(1),
    "sampler": one_of("tpe", "random", "grid"),
    "startup": _make_whole_number_rule(1),
    "seed": _make_whole_number_rule(0),
    "pruner": one_of("median", "none"),
    "prune_after": _make_whole_number_rule(1),
}


def parse_search(content: Mapping[str, Any], best: Mapping[str, Value] | None = None) -> Search:
    """Return the search that the config group `search` describes; `best` has the values of an earlier
    search's best trial, by key. Raises InputError for invalid content."""
    keys = [one.name for one in fields(Search)]
    for key in content:
        if key not in keys:
            raise InputError(f"search.{key}: no such key; expected one of {', '.join(keys)}")
    for key in keys:
        if key not in content:
            raise InputError(f"search.{key}: has no value; set search.{key}=VALUE")
    values = {**content, "name": str(content["name"])}
    optional = {"startup": values["sampler"] != "tpe", "prune_after": values["pruner"] == "none"}
    for key, rule in RULES.items():
        if not (values[key] is None and optional.get(key)) and not rule.allows(values[key]):
            raise InputError(f"search.{key}={values[key]}: must be {rule.words}")
    values["base"] = tuple(values["base"])
    values["space"] = space = tuple(_parse_ranges(values["space"], "", best or {}))
    values["objectives"] = objectives = tuple(map(_parse_objective, values["objectives"]))
    if not space:
        raise InputError("search.space: empty; expected config keys with low and high, or with choices")
    if len(objectives) not in (1, 2) or len({one.text for one in objectives}) < len(objectives):
        expected = "one objective, or two different objectives for a Pareto front"
        raise InputError(f"search.objectives: expected {expected}")
    if len(objectives) > 1 and values["pruner"] != "none":
        raise InputError(f"search.pruner={values['pruner']}: must be none with two objectives")
    if values["seeds"] != 1 and any(one.key == "seed" for one in space):
        raise InputError(f"search.seeds={values['seeds']}: must be 1 if search.space contains seed")
    if values["sampler"] == "grid":
        _check_grid(space, values["n_trials"])
    return Search(**values)


def _check_grid(space: Sequence[Range], n_trials: Any) -> None:
    for one in space:
        if not one.choices or one.first is not None:
            expected = "must have choices, without low, high and first"
            raise InputError(f"search.space.{one.key}: {expected}, if search.sampler=grid")
    combinations = math.prod(len(one.choices) for one in space)
    if n_trials != combinations:
        expected = f"must be {combinations}, the number of combinations"
        raise InputError(f"search.n_trials={n_trials}: {expected}, with search.sampler=grid")


def _parse_ranges(node: Any, prefix: str, best: Mapping[str, Value]) -> Iterator[Range]:
    """Yield the ranges in a tree of keys, without keys that are null. A group may have choices and keys."""
    if node is None:
        return
    where = f"search.space{'.' if prefix else ''}{prefix}"
    if not isinstance(node, Mapping):
        raise InputError(f"{where}: {node!r}; expected a mapping with low and high, or with choices")
    own = {key: value for key, value in node.items() if key in RANGE_KEYS}
    for key, child in node.items():
        if key in own:
            continue
        if own and not (child is None or isinstance(child, Mapping)):
            raise InputError(f"{where}.{key}: no such key; expected one of {', '.join(RANGE_KEYS)}")
        yield from _parse_ranges(child, f"{prefix}.{key}" if prefix else str(key), best)
    if own:
        yield _parse_range(prefix, own, where, best)


def _parse_range(key: str, node: Mapping[str, Any], where: str, best: Mapping[str, Value]) -> Range:
    if "factor" in node:
        return _parse_factor(key, node, where, best.get(key))
    found = _parse_choices(key, node, where) if "choices" in node else _parse_interval(key, node, where)
    if found.first is not None and not found.allows(found.first):
        raise InputError(f"{where}.first={found.first}: must be within the range")
    return found


def _parse_factor(key: str, node: Mapping[str, Any], where: str, value: Value) -> Range:
    """Return the range around the value in the best trial of `search.after`; it begins with this value."""
    factor = _parse_number(node["factor"], f"{where}.factor")
    if len(node) > 1 or factor <= 1:
        raise InputError(f"{where}.factor={factor}: must be above 1, without other keys")
    if isinstance(value, bool) or not isinstance(value, int | float) or value <= 0:
        raise InputError(f"{where}.factor: needs search.after, a search whose best trial has {key}, above 0")
    return Range(key, value / factor, value * factor, log=True, first=float(value))


def _parse_choices(key: str, node: Mapping[str, Any], where: str) -> Range:
    choices = node["choices"]
    if isinstance(choices, list):
        choices = [format_value(one) if isinstance(one, list) else one for one in choices]
    plain = isinstance(choices, Sequence) and all(isinstance(one, int | float | str) for one in choices)
    if isinstance(choices, str) or not plain or len(set(choices)) < max(len(choices), 2):
        raise InputError(f"{where}.choices: expected a list of at least two different values")
    for other in set(node) - {"choices", "first"}:
        raise InputError(f"{where}.{other}: cannot be combined with choices")
    return Range(key, choices=tuple(choices), first=node.get("first"))


def _parse_interval(key: str, node: Mapping[str, Any], where: str) -> Range:
    low, high = (_parse_number(node.get(end), f"{where}.{end}") for end in ("low", "high"))
    log, step, first = node.get("log", False), node.get("step"), node.get("first")
    if not isinstance(log, bool):
        raise InputError(f"{where}.log={log}: must be true or false")
    if low >= high:
        raise InputError(f"{where}.high={high}: must be greater than low={low}")
    if log and low <= 0:
        raise InputError(f"{where}.low={low}: must be above 0 with log")
    if step is not None and (log or _parse_number(step, f"{where}.step") <= 0):
        raise InputError(f"{where}.step={step}: must be above 0, and cannot be combined with log")
    for name, value in (("step", step), ("first", first)):
        if isinstance(low, int) and isinstance(high, int) and not isinstance(value, int | None):
            expected = "must be a whole number if low and high are whole numbers"
            raise InputError(f"{where}.{name}={value}: {expected}")
    if step is not None and step > high - low:
        raise InputError(f"{where}.step={step}: must be at most high - low")
    if step is not None and first is not None and abs((first - low) / step % 1 - 0.5) < 0.5 - 1e-9:
        raise InputError(f"{where}.first={first}: must be low plus a multiple of step")
    return Range(key, low, high, log, step, first=first)


def _parse_objective(text: str) -> Objective:
    """Parse an objective such as "MPJPE", or "MPJPE + 0.1*position Jitter"."""
    return Objective(text, tuple(_parse_term(part.strip(), text) for part in text.split("+")))


def _parse_term(part: str, text: str) -> tuple[float, str]:
    """Parse a term into weight and metric. A metric without a branch is measured on the rotation branch."""
    match = re.fullmatch(r"(?:(\d+\.?\d*(?:[eE][+-]?\d+)?)\s*\*\s*)?(?:(\w+)\s+)??(\w+(?: PE)?)", part)
    branch, metric = (match[2] or OBJECTIVE_BRANCHES[0], match[3]) if match else ("", "")
    if match is None or metric not in UNITS or branch not in OBJECTIVE_BRANCHES:
        names, branches = ", ".join(UNITS), " or ".join(OBJECTIVE_BRANCHES)
        raise InputError(
            f"search.objectives: '{text}'; must be a sum of terms such as '0.5 * position MPJPE'; weight "
            f"and branch ({branches}) may be omitted, METRIC is one of {names}"
        )
    if metric in HIGHER:
        reason = f"higher values of {metric} are better, so it cannot be minimised"
        raise InputError(f"search.objectives: '{text}'; {reason}")
    weight = float(match[1] or 1)
    if not 0 < weight < math.inf:
        raise InputError(f"search.objectives: '{text}'; weights must be above 0")
    return weight, f"{branch} {metric}"


def _parse_number(value: Any, name: str) -> float | int:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{name}: {'nothing' if value is None else value}; expected a number")
    return value


def read_best_trial(folder: Path) -> tuple[tuple[str, ...], dict[str, Value]]:
    """Return the overrides of all trials of a finished search, and the values of its best trial by key.
    Raises InputError if the folder has no finished search, a damaged one, or one without a complete trial."""
    record, path = folder / "search.json", folder / "trials.csv"
    if damage := records.find_damage(record, SearchRecord):
        raise InputError(damage)
    content = records.read(record, SearchRecord)
    if "command_line" not in content or not path.is_file():
        expected = "must be the folder of a finished search, with search.json and trials.csv"
        raise InputError(f"{folder}: {expected}")
    objective, keys = content["objectives"][0]["text"], [one["key"] for one in content["space"]]
    try:
        trials = [row for row in parse_csv(path.read_text(encoding="utf-8")) if row["state"] == "complete"]
        best = min(trials, key=lambda row: float(row[objective]), default=None)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: must be the trials of a search ({error})") from None
    if best is None:
        raise InputError(f"{folder}: no trial is complete; expected a search with a best trial")
    overrides = (*content["base"], *content["command_line"])
    return overrides, {key: parse_config_yaml(text) for key in keys if (text := best[key])}
