"""The page as one file, with a server's answers about some sweeps, their runs, and all searches."""

from __future__ import annotations

import math
import urllib.parse
from collections.abc import Collection, Iterable, Mapping
from typing import Any, NamedTuple

from memmlp.report.ui import pages
from memmlp.report.ui.curves import thinned
from memmlp.report.ui.replay import body
from memmlp.report.ui.routes import MODES, Answers
from memmlp.report.ui.sweeps import table_words
from memmlp.tables.table import Table

POINTS = 120  # of a curve, about
MOST_CLIPS = 60  # of a run, its worst
SECONDS = 4  # the length of a replay
MOST_REPLAYS = 4
ERROR = "stream.rotation.MPJPE"
CURVES = ("train loss", "val rotation ", "val position MPJPE", "val loss")
"""Curves whose names begin like this are kept."""


class ReportedSweep(NamedTuple):
    """A sweep in the file: the name of its folder below outputs/sweeps, and its table."""

    name: str
    table: Table


def page_text(answers: Answers, sweeps: Iterable[ReportedSweep], extra: str, replays: bool = True) -> str:
    """Return the page as one file.

    Args:
        answers: answers about the outputs folder.
        sweeps: the sweeps to show, with all of their runs that have begun.
        extra: HTML of the page "Tables and figures".
        replays: whether the worst seconds of the best runs are computed and shown.
    """
    answers.look()
    plans = {plan.name: plan for plan in answers.sweeps.known()}
    wanted = [one for one in sweeps if one.name in plans]
    ids = {task.id for one in wanted for task in plans[one.name].tasks if task.id in answers.index.runs}
    found: dict[str, Any] = {
        "runs": _rows(answers, ids),
        "body": body(),
        "curves": {run_id: _curves(answers, run_id) for run_id in sorted(ids)},
        "sweeps": {"sweeps": [answers.sweeps.progress(plans[one.name]) for one in wanted], "damaged": {}},
        "searches": answers.searches.rows(),
    }
    for one in wanted:
        page = answers.sweeps.page(one.name)
        found[f"sweeps/{one.name}"] = {**page, "table": table_words(one.table)}
    for name in answers.searches.names():
        found[f"searches/{name}"] = answers.searches.page(name)
    for run_id in sorted(ids):
        found[f"run/{run_id}"] = _run(answers.of(f"run/{run_id}", {}))
    if replays:
        found |= _replays(answers, [[e.id for e in plans[one.name].entries] for one in wanted], found)
    return pages.one_file(rounded(found), extra)


def _rows(answers: Answers, ids: Collection[str]) -> dict[str, Any]:
    found = answers.rows.since(0)
    return {**found, "rows": [row for row in found["rows"] if row["id"] in ids], "outputs": ""}


def _curves(answers: Answers, run_id: str) -> dict[str, Any]:
    every = answers.curves.of(run_id)
    return {
        name: thinned(dict(zip(*points, strict=True)), POINTS)
        for name, points in every.items()
        if name.startswith(CURVES)
    }


def _run(page: Mapping[str, Any]) -> dict[str, Any]:
    """Return a run's page without the parts that only its server could show."""
    clips = sorted(page["clips"], key=_error, reverse=True)[:MOST_CLIPS]
    manifest = {
        key: value
        for key, value in page["manifest"].items()
        if not key.startswith(("sources", "attempts", "upstream_runs"))
    }
    return {**page, "clips": clips, "manifest": manifest}


def _error(clip: Mapping[str, Any]) -> float:
    """Return a clip's error, by which clips are sorted: infinite if it is no number, 0 if there is none."""
    for mode in MODES:
        if (value := clip.get(mode, {}).get("rotation", {}).get("MPJPE")) is not None:
            return float(value) if math.isfinite(float(value)) else math.inf
    return 0.0


def _replays(answers: Answers, sweeps: Iterable[list[str]], found: Mapping[str, Any]) -> dict[str, Any]:
    """Return the worst seconds of the worst clip of each sweep's best run, and its control's of that clip."""
    made: dict[str, Any] = {}
    for ids in sweeps:
        known = {
            run_id: answers.index.runs[run_id]["metrics"].get(ERROR)
            for run_id in ids
            if run_id in answers.index.runs
        }
        best = min(
            (run_id for run_id, error in known.items() if error is not None),
            key=lambda one: known[one],
            default=None,
        )
        if best is None or len(made) >= MOST_REPLAYS:
            continue
        page = found[f"run/{best}"]
        if not page["clips"]:
            continue
        clip, begin = page["clips"][0]["name"], None
        for run_id in [best, *([page["control"]["id"]] if page["control"] else [])]:
            piece = answers.replays.get_waiting(run_id, clip, MODES[0], begin, SECONDS)
            if piece["state"] == "ready":
                made[f"replay/{run_id}?{query(clip=clip, mode=MODES[0])}"] = piece
                begin = piece["from"] / piece["fps"]
    return made


def query(**words: str) -> str:
    """Return words encoded as a browser's URLSearchParams encodes them."""
    return urllib.parse.urlencode(words).replace("~", "%7E").replace("%2A", "*")


def rounded(value: Any) -> Any:
    """Return a value with all its numbers rounded to six digits; NaN and infinities become None."""
    if isinstance(value, Mapping):
        return {str(key): rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(item) for item in value]
    if isinstance(value, float):
        short = float(f"{value:.6g}")
        return short if abs(short) < float("inf") else None
    return value
