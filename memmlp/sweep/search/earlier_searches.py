"""Reads finished searches from their folders: the best trial, and a summary of all trials."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from memmlp.common.errors import InputError
from memmlp.common.files import read_json
from memmlp.common.overrides import parse_overrides
from memmlp.runs.run import Run
from memmlp.sweep.search.search_file import Search, Value


@dataclass(frozen=True)
class BestTrial:
    """The best trial of a finished search: its values by key, and all its overrides."""

    values: Mapping[str, Value] = field(default_factory=dict)
    overrides: tuple[str, ...] = ()


@dataclass(frozen=True)
class FinishedSearch:
    """A finished search.

    Attributes:
        folder: the search's folder; its name identifies the search.
        content: the search file's keys, and `command_line`.
        trials: the rows of trials.csv.
    """

    folder: Path
    content: Mapping[str, Any]
    trials: list[dict[str, str]]

    @property
    def objective(self) -> str:
        """The first objective."""
        return str(self.content["objectives"][0]["text"])

    @property
    def keys(self) -> list[str]:
        """The searched keys."""
        return [one["key"] for one in self.content["space"]]

    @property
    def overrides(self) -> list[str]:
        """The overrides of all trials."""
        return [*self.content["base"], *self.content["command_line"]]

    @property
    def network(self) -> str:
        """The overrides that choose the network, such as "model=mem_mlp model.frames=60"."""
        chosen = [one for one in parse_overrides(self.overrides) if one.group == "model"]
        return " ".join(one.text for one in chosen) or "model=mem_mlp"

    @property
    def complete(self) -> list[dict[str, str]]:
        """The complete trials, the best one first."""
        complete = [row for row in self.trials if row["state"] == "complete"]
        return sorted(complete, key=lambda row: float(row[self.objective]))

    def get_values(self, row: Mapping[str, str]) -> dict[str, Value]:
        """Return a trial's values by key."""
        return {key: yaml.safe_load(row[key]) for key in self.keys if row[key] != ""}

    def measure_compute(self, row: Mapping[str, str]) -> list[float]:
        """Return the recorded compute of a trial's runs, TFLOP."""
        runs = (Run.from_id(self.folder.parent.parent, name) for name in row["run"].split())
        return [float(found) for run in runs if (found := run.manifest.get("tflop")) is not None]


def read_search(folder: Path) -> FinishedSearch:
    """Read a search's folder. Raises InputError if it is not the folder of a finished search."""
    content, path = read_json(folder / "search.json"), folder / "trials.csv"
    if "command_line" not in content or not path.is_file():
        raise InputError(
            f"{folder}: must be the folder of a finished search, with search.json and trials.csv"
        )
    return FinishedSearch(folder, content, list(csv.DictReader(io.StringIO(path.read_text()))))


def read_best_trial(folder: Path) -> BestTrial:
    """Read the best trial of a finished search. Raises InputError if no trial is complete."""
    search = read_search(folder)
    if not search.complete:
        raise InputError(f"{folder}: no trial is complete; expected a search with a best trial")
    values = search.get_values(search.complete[0])
    return BestTrial(values, (*search.overrides, *Search.overrides(values)))


def format_trials(searches: Iterable[FinishedSearch]) -> str:
    """Return all trials of several searches as CSV, with recorded compute and the union of all keys."""
    every = list(searches)
    keys = list(dict.fromkeys(key for one in every for key in one.keys))
    head = [
        "search",
        "network",
        "budget",
        "trial",
        "state",
        "objective",
        "value",
        "sd",
        "tflop",
        *keys,
        "run",
    ]
    text = io.StringIO()
    writer = csv.DictWriter(text, head, lineterminator="\n", restval="")
    writer.writeheader()
    for search in every:
        about = {"search": search.folder.name, "network": search.network, "budget": search.content["tflop"]}
        for row in search.trials:
            tflop = " ".join(f"{one:.4g}" for one in search.measure_compute(row))
            name = search.objective
            facts = {"objective": name, "value": row[name], "sd": row.get(f"{name} sd", ""), "tflop": tflop}
            copied = {key: row[key] for key in ("trial", "state", "run", *search.keys)}
            writer.writerow({**about, **facts, **copied})
    return text.getvalue()


def format_summary(searches: Iterable[FinishedSearch]) -> Iterator[str]:
    """Yield the lines of a Markdown table with each search's budget and best trial."""
    yield "| search | network | TFLOP | recorded, TFLOP | complete trials | best on validation | values |"
    yield "|---|---|---|---|---|---|---|"
    for one in searches:
        compute = [found for row in one.complete for found in one.measure_compute(row)]
        recorded = f"{min(compute):.3g} to {max(compute):.3g}" if compute else "-"
        best = one.complete[0] if one.complete else {}
        spread = f" ± {float(sd):.3f}" if (sd := best.get(f"{one.objective} sd")) else ""
        result = f"{one.objective} {float(best[one.objective]):.3f}{spread}" if best else "-"
        values = " ".join(Search.overrides(one.get_values(best))) if best else ""
        counts = f"{len(one.complete)} of {len(one.trials)}"
        cells = (one.folder.name, one.network, one.content["tflop"] or "-", recorded, counts, result, values)
        yield f"| {' | '.join(map(str, cells))} |"
