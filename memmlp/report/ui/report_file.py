"""`memmlp report`: the page as one file, with the answers about some sweeps, their runs, and all searches."""

from __future__ import annotations

import math
import urllib.parse
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.report.ui.page_files import one_file
from memmlp.report.ui.runs import read_curves, thin_out
from memmlp.report.ui.server import Answers
from memmlp.report.ui.sweeps import KnownSweep
from memmlp.runs.run import Run
from memmlp.sweep.definition import MODES

MAX_POINTS = 120  # of a curve, about
MAX_CLIPS = 60  # of a run, its worst
MAX_REPLAYS = 4  # in the file
REPLAY_SECONDS = 4
ERROR = "stream.rotation.MPJPE"  # by which the best run of a sweep is found
CURVES = ("train loss", "val rotation ", "val position MPJPE", "val loss")  # beginnings of names
LONG_FACTS = ("source", "attempts", "prerequisite_runs")  # of a manifest, left out


def write_page(answers: Answers, names: Collection[str], about: str, replays: bool = True) -> str:
    """Return the page as one file.

    Args:
        answers: answers about the outputs folder.
        names: the sweeps to show, with their runs: files, numbers of the paper's tables, or names of folders
            below outputs/sweeps; all sweeps if there are none.
        about: when and by which code the file is made.
        replays: whether the worst seconds of the best runs are computed and shown.

    Raises:
        InputError: if there is no sweep with a given name, or no sweep at all.
    """
    answers.refresh()
    shown = _select_sweeps(answers, names)
    ids = {task.id for known in shown.values() for task in known.plan.tasks if task.id in answers.index.runs}
    rows, sweeps = answers.answer("runs", {}), answers.sweeps.list_rows()["sweeps"]
    found: dict[str, Any] = {
        "about": about,
        "runs": {**rows, "rows": [row for row in rows["rows"] if row["id"] in ids], "outputs": ""},
        "body": answers.answer("body", {}),
        "curves": {run_id: _read_curves(Run.from_id(answers.outputs, run_id)) for run_id in sorted(ids)},
        "sweeps": {"sweeps": [row for row in sweeps if row["name"] in shown], "damaged": {}},
        "searches": answers.searches.list_rows(),
        **{f"sweeps/{name}": answers.sweeps.describe(name) for name in shown},
        **{f"searches/{name}": answers.searches.describe(name) for name in answers.searches.names()},
        **{f"run/{run_id}": _shorten(answers.answer(f"run/{run_id}", {})) for run_id in sorted(ids)},
    }
    if replays:
        planned = [[entry.id for entry in known.plan.entries] for known in shown.values()]
        found |= _replay_best_runs(answers, planned, found)
    return one_file(round_numbers(found))


def _select_sweeps(answers: Answers, names: Collection[str]) -> dict[str, KnownSweep]:
    known = answers.sweeps.known
    folder, expected = answers.outputs / "sweeps", ", ".join(known) or "none; memmlp sweep makes them"
    if not known:
        raise InputError(f"{folder}: has {expected}")
    shown: dict[str, KnownSweep] = {}
    for name in names:
        stem = f"table{int(name):02}" if name.isdigit() else Path(name).stem
        found = {one: known[one] for one in known if one == stem or one.startswith(f"{stem}-")}
        if not found:
            raise InputError(f"{name}: not found in {folder}, which has {expected}")
        shown |= found
    return shown or known


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
