"""`memmlp report`: the page as one file, with selected sweeps, their runs, and all searches."""

import math
import urllib.parse
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.report.ui.runs import SECONDS, read_curves, thin_out
from memmlp.report.ui.server import Answers, make_single_file
from memmlp.report.ui.sweeps import KnownSweep
from memmlp.runs.run import Run
from memmlp.sweep.definition import MODES

MAX_POINTS = 120  # approximate maximum number of points of a curve
MAX_LOG = 1000  # characters of a run's log
MAX_CLIPS = 40  # maximum number of clips of a run
MAX_REPLAYS = 4  # maximum number of replays
REPLAY_SECONDS = 4
ERROR = "stream.rotation.MPJPE"  # metric that selects a sweep's best run
CURVES = (SECONDS, "train loss", "val rotation ", "val position MPJPE", "val loss")  # prefixes of curve names
LONG_FACTS = ("source", "attempts", "prerequisite_runs")  # prefixes of manifest keys that are left out


def write_page(answers: Answers, names: Collection[str], about: str, replays: bool = True) -> str:
    """Return the page as one file.

    Args:
        answers: answers about the outputs folder.
        names: the sweeps to show, with their runs: sweep files, table numbers from the paper, or folder names
            in outputs/sweeps. All sweeps if empty.
        about: date and code version of the page.
        replays: whether to compute and show the worst seconds of the best runs.

    Raises:
        InputError: if a sweep is not found, or there are no sweeps.
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
        **{f"searches/{name}": answers.searches.describe(name) for name in answers.searches.list_names()},
        **{f"run/{run_id}": _shorten_run_page(answers.answer(f"run/{run_id}", {})) for run_id in sorted(ids)},
    }
    if replays:
        planned = [[entry.id for entry in known.plan.entries] for known in shown.values()]
        found |= _replay_best_runs(answers, planned, found)
    return make_single_file(round_numbers(found))


def _select_sweeps(answers: Answers, names: Collection[str]) -> dict[str, KnownSweep]:
    sweeps = answers.sweeps.known
    folder = answers.outputs / "sweeps"
    if not sweeps:
        raise InputError(f"{folder}: contains no sweeps; make them with: memmlp sweep")
    shown: dict[str, KnownSweep] = {}
    for name in names:
        stem = f"table{int(name):02}" if name.isdigit() else Path(name).stem
        selected = {one: sweeps[one] for one in sweeps if one == stem or one.startswith(f"{stem}-")}
        if not selected:
            raise InputError(f"{name}: must be a sweep in {folder}: {', '.join(sweeps)}")
        shown |= selected
    return shown or sweeps


def _read_curves(run: Run) -> dict[str, Any]:
    return {
        name: thin_out(dict(zip(*points, strict=True)), MAX_POINTS)
        for name, points in read_curves(run).items()
        if name.startswith(CURVES)
    }


def _shorten_run_page(page: Mapping[str, Any]) -> dict[str, Any]:
    """Keep only the clips with the largest errors on a run's page, and shorten the manifest."""
    manifest = {key: value for key, value in page["manifest"].items() if not key.startswith(LONG_FACTS)}
    clips = sorted(page["clips"], key=_find_sort_error, reverse=True)[:MAX_CLIPS]
    clips = [_shorten_clip(clip) for clip in clips]
    return {**page, "clips": clips, "manifest": manifest, "log": page["log"][-MAX_LOG:], "patch": ""}


def _shorten_clip(clip: Mapping[str, Any]) -> dict[str, Any]:
    """Keep the errors that a run's page shows: the rotation branch of its first mode, and others' MPJPE."""
    first, *others = [mode for mode in MODES if mode in clip] or [""]
    shown = {mode: {"rotation": {"MPJPE": clip[mode].get("rotation", {}).get("MPJPE")}} for mode in others}
    if first:
        shown[first] = {"rotation": clip[first].get("rotation", {})}
    return {**{key: value for key, value in clip.items() if key not in MODES}, **shown}


def _find_sort_error(clip: Mapping[str, Any]) -> float:
    """Return a clip's error for sorting; infinity for NaN, and 0 for a clip without results."""
    for mode in MODES:
        if (value := clip.get(mode, {}).get("rotation", {}).get("MPJPE")) is not None:
            return float(value) if math.isfinite(float(value)) else math.inf
    return 0.0


def _replay_best_runs(
    answers: Answers, sweeps: Iterable[list[str]], pages: Mapping[str, Any]
) -> dict[str, Any]:
    """Return replays of each sweep's best run and its control, on the clip with the largest error."""
    replays: dict[str, Any] = {}
    for ids in sweeps:
        runs = [answers.index.runs[run_id] for run_id in ids if run_id in answers.index.runs]
        measured = [run for run in runs if isinstance(run["metrics"].get(ERROR), float)]
        if not measured or len(replays) >= MAX_REPLAYS:
            continue
        page = pages[f"run/{min(measured, key=lambda run: run['metrics'][ERROR])['id']}"]
        if not page["clips"]:
            continue
        clip, begin = page["clips"][0]["name"], None
        for run_id in [page["id"], *([page["control"]["id"]] if page["control"] else [])]:
            piece = answers.replays.get(run_id, clip, MODES[0], begin, REPLAY_SECONDS, timeout=None)
            if piece["state"] == "ready":
                replays[f"replay/{run_id}?{encode_query(clip=clip, mode=MODES[0])}"] = piece
                begin = piece["from"] / piece["fps"]
    return replays


def encode_query(**values: str) -> str:
    """Encode a query like URLSearchParams in a browser."""
    return urllib.parse.urlencode(values).replace("~", "%7E").replace("%2A", "*")


def round_numbers(value: Any) -> Any:
    """Round all numbers in a value to six significant digits; NaN and infinity become None."""
    if isinstance(value, Mapping):
        return {str(key): round_numbers(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [round_numbers(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
