"""`memmlp report`: the page as one file, with the answers about some sweeps, their runs, and all searches."""

from __future__ import annotations

import math
import urllib.parse
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from memmlp.report.tables.effects import RunsBySeed
from memmlp.report.tables.table import Table
from memmlp.report.ui.page_files import one_file
from memmlp.report.ui.runs import read_curves, thin_out
from memmlp.report.ui.server import Answers
from memmlp.report.ui.sweeps import describe_results, name_sweep
from memmlp.runs.run import Run
from memmlp.sweep.definition import MODES, Sweep

MAX_POINTS = 120  # of a curve, about
MAX_CLIPS = 60  # of a run, its worst
MAX_REPLAYS = 4  # in the file
REPLAY_SECONDS = 4
ERROR = "stream.rotation.MPJPE"  # by which the best run of a sweep is found
CURVES = ("train loss", "val rotation ", "val position MPJPE", "val loss")  # beginnings of names
LONG_FACTS = ("source", "attempts", "prerequisite_runs")  # of a manifest, left out


class ReportedSweep(NamedTuple):
    """A sweep in the file.

    Attributes:
        name: the name of its folder below outputs/sweeps, which need not exist.
        sweep: its definition.
        runs: the finished runs by the variant's label and the seed.
        table: their table.
    """

    name: str
    sweep: Sweep
    runs: Mapping[str, RunsBySeed]
    table: Table

    @property
    def missing(self) -> float:
        """The fraction of variants without a run."""
        variants = self.sweep.runnable()
        return sum(not self.runs.get(variant.label) for variant in variants) / max(len(variants), 1)


def write_page(answers: Answers, sweeps: Iterable[ReportedSweep], about: str, replays: bool = True) -> str:
    """Return the page as one file; sweeps with the most runs come first.

    Args:
        answers: answers about the outputs folder.
        sweeps: the sweeps to show, with all of their runs that have started.
        about: when and by which code the file is made.
        replays: whether the worst seconds of the best runs are computed and shown.
    """
    answers.refresh()
    sweeps = sorted(sweeps, key=lambda one: one.missing)
    pages = {one.name: _describe_sweep(answers, one) for one in sweeps}
    planned = [answers.sweeps.known[name].plan for name in pages if name in answers.sweeps.known]
    ids = {task.id for plan in planned for task in plan.tasks if task.id in answers.index.runs}
    rows = answers.answer("runs", {})
    progress = set(next(iter(answers.sweeps.list_rows()["sweeps"]), _progress_of_unplanned(sweeps[0])))
    found: dict[str, Any] = {
        "about": about,
        "runs": {**rows, "rows": [row for row in rows["rows"] if row["id"] in ids], "outputs": ""},
        "body": answers.answer("body", {}),
        "curves": {run_id: _read_curves(Run.of(answers.outputs, run_id)) for run_id in sorted(ids)},
        "sweeps": {
            "sweeps": [{key: page[key] for key in progress} for page in pages.values()], "damaged": {},
        },
        "searches": answers.searches.list_rows(),
        **{f"sweeps/{name}": page for name, page in pages.items()},
        **{f"searches/{name}": answers.searches.describe(name) for name in answers.searches.names()},
        **{f"run/{run_id}": _shorten(answers.answer(f"run/{run_id}", {})) for run_id in sorted(ids)},
    }  # fmt: skip
    if replays:
        found |= _replay_best_runs(answers, [[e.id for e in plan.entries] for plan in planned], found)
    return one_file(round_numbers(found))


def _describe_sweep(answers: Answers, one: ReportedSweep) -> dict[str, Any]:
    results = describe_results(one.sweep, one.table)
    if one.name in answers.sweeps.known:
        return answers.sweeps.describe(one.name) | results
    return {**_progress_of_unplanned(one), "cells": [], "prerequisites": [], "rounds": None, **results}


def _progress_of_unplanned(one: ReportedSweep) -> dict[str, Any]:
    count = len(one.sweep.runnable()) * len(one.sweep.seeds)
    return {
        **name_sweep(one.name, one.sweep), "variants": len(one.sweep.variants), "seeds": len(one.sweep.seeds),
        "tasks": count, "counts": {"new": count}, "prerequisite_counts": {}, "share": 0.0, "remaining": None,
    }  # fmt: skip


def _read_curves(run: Run) -> dict[str, Any]:
    return {
        name: thin_out(dict(zip(*points, strict=True)), MAX_POINTS)
        for name, points in read_curves(run).items()
        if name.startswith(CURVES)
    }


def _shorten(page: Mapping[str, Any]) -> dict[str, Any]:
    """Return a run's page with the worst clips alone, and a short manifest."""
    manifest = {key: value for key, value in page["manifest"].items() if not key.startswith(LONG_FACTS)}
    clips = sorted(page["clips"], key=_error, reverse=True)[:MAX_CLIPS]
    return {**page, "clips": clips, "manifest": manifest}


def _error(clip: Mapping[str, Any]) -> float:
    """Return a clip's error for sorting: infinite if it is NaN, 0 if the clip was not evaluated."""
    for mode in MODES:
        if (value := clip.get(mode, {}).get("rotation", {}).get("MPJPE")) is not None:
            return float(value) if math.isfinite(float(value)) else math.inf
    return 0.0


def _replay_best_runs(
    answers: Answers, sweeps: Iterable[list[str]], pages: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the worst seconds of the worst clip of each sweep's best run, and its control's of that clip."""
    found: dict[str, Any] = {}
    for ids in sweeps:
        runs = [answers.index.runs[run_id] for run_id in ids if run_id in answers.index.runs]
        measured = [run for run in runs if ERROR in run["metrics"]]
        if not measured or len(found) >= MAX_REPLAYS:
            continue
        page = pages[f"run/{min(measured, key=lambda run: run['metrics'][ERROR])['id']}"]
        if not page["clips"]:
            continue
        clip, begin = page["clips"][0]["name"], None
        for run_id in [page["id"], *([page["control"]["id"]] if page["control"] else [])]:
            piece = answers.replays.get(run_id, clip, MODES[0], begin, REPLAY_SECONDS, timeout=None)
            if piece["state"] == "ready":
                found[f"replay/{run_id}?{encode_query(clip=clip, mode=MODES[0])}"] = piece
                begin = piece["from"] / piece["fps"]
    return found


def encode_query(**values: str) -> str:
    """Return a query encoded as a browser's URLSearchParams encodes it."""
    return urllib.parse.urlencode(values).replace("~", "%7E").replace("%2A", "*")


def round_numbers(value: Any) -> Any:
    """Return a value with all its numbers rounded to six digits; NaN and infinities become None."""
    if isinstance(value, Mapping):
        return {str(key): round_numbers(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [round_numbers(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
