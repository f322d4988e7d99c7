"""Reads finished searches from their folders, for a later search and for summaries."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.overrides import parse_overrides
from memmlp.common.schema import parse_config_yaml
from memmlp.common.text_formats import format_csv, parse_csv
from memmlp.runs import records
from memmlp.runs.records import SearchRecord
from memmlp.runs.run import Run
from memmlp.sweep.search.search_file import Search, Value


class FinishedSearch:
    """A finished search.

    Args:
        folder: the search's folder, outputs/tune/NAME-ID.

    Attributes:
        content: the keys of the search file.
        objective: the first objective.
        keys: the searched keys.
        overrides: the overrides of all trials.
        network: the overrides that choose the network, such as "model=mem_mlp model.frames=60".
        trials: the rows of trials.csv.
        complete: the complete trials, the best one first.

    Raises:
        InputError: if the folder does not have a finished search.
    """

    def __init__(self, folder: Path):
        content, path = records.read(folder / "search.json", SearchRecord), folder / "trials.csv"
        if damage := records.find_damage(folder / "search.json", SearchRecord):
            raise InputError(damage)
        if "command_line" not in content or not path.is_file():
            raise InputError(
                f"{folder}: must be the folder of a finished search, with search.json and trials.csv"
            )
        self.folder, self.content = folder, content
        self.objective = content["objectives"][0]["text"]
        self.keys = [one["key"] for one in content["space"]]
        self.overrides = (*content["base"], *content["command_line"])
        model = [one.text for one in parse_overrides(self.overrides) if one.group == "model"]
        self.network = " ".join(model) or "model=mem_mlp"
        try:
            self.trials = parse_csv(path.read_text(encoding="utf-8"))
            complete = [row for row in self.trials if row["state"] == "complete"]
            self.complete = sorted(complete, key=lambda row: float(row[self.objective]))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: must be the trials of a search ({error})") from None

    @property
    def best_values(self) -> dict[str, Value]:
        """The values of the best trial by key. Raises InputError if no trial is complete."""
        if not self.complete:
            raise InputError(f"{self.folder}: no trial is complete; expected a search with a best trial")
        return {key: parse_config_yaml(text) for key in self.keys if (text := self.complete[0][key])}

    def measure_compute(self, row: Mapping[str, str]) -> list[float]:
        """Return the recorded compute of a trial's runs, TFLOP."""
        runs = (Run.from_id(self.folder.parent.parent, name) for name in row["run"].split())
        return [float(tflop) for run in runs if (tflop := run.manifest.get("tflop")) is not None]


def format_trials(searches: Sequence[FinishedSearch]) -> str:
    """Return all trials of several searches as CSV, with recorded compute and the keys of all searches."""
    keys = dict.fromkeys(key for search in searches for key in search.keys)
    columns = [
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
    rows: list[list[Any]] = [columns]
    for search in searches:
        name, budget = search.objective, search.content["tflop"]
        about: dict[str, Any] = {"search": search.folder.name, "network": search.network, "budget": budget}
        for row in search.trials:
            tflop = " ".join(f"{one:.4g}" for one in search.measure_compute(row))
            result = {"objective": name, "value": row[name], "sd": row.get(f"{name} sd"), "tflop": tflop}
            cells = {**about, **result}
            rows.append([cells.get(column, row.get(column)) for column in columns])
    return format_csv(rows)


def format_summary(searches: Sequence[FinishedSearch]) -> Iterator[str]:
    """Yield the lines of a Markdown table with each search's budget and best trial."""
    yield "| search | network | TFLOP | recorded, TFLOP | complete trials | best on validation | values |"
    yield "|---|---|---|---|---|---|---|"
    for search in searches:
        compute = [one for row in search.complete for one in search.measure_compute(row)]
        recorded = f"{min(compute):.3g} to {max(compute):.3g}" if compute else "-"
        result = values = "-"
        if search.complete:
            best, name = search.complete[0], search.objective
            sd = f" ± {float(best[f'{name} sd']):.3f}" if f"{name} sd" in best else ""
            result, values = (
                f"{name} {float(best[name]):.3f}{sd}",
                " ".join(Search.overrides(search.best_values)),
            )
        count = f"{len(search.complete)} of {len(search.trials)}"
        budget = search.content["tflop"] or "-"
        cells = search.folder.name, search.network, budget, recorded, count, result, values
        yield f"| {' | '.join(map(str, cells))} |"
