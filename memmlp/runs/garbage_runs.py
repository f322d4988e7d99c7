"""Finds unneeded runs, and deletes runs. Failed runs, runs with older component versions and orphans are
unneeded."""

import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from memmlp.common.errors import InputError
from memmlp.common.files import read_json
from memmlp.common.lease import is_alive
from memmlp.runs.environment import collect_prerequisite_versions
from memmlp.runs.identity import NETWORK, list_outdated
from memmlp.runs.lookup import describe_kind, list_runs, log_action, read_notes
from memmlp.runs.run import Run

REASONS = ("failed", "old", "orphaned")


class GarbageRun(NamedTuple):
    """A run that may be deleted: `kind` is one of REASONS, `size` that of its folder in bytes."""

    run: Run
    kind: str
    reason: str
    size: int


def find_garbage(outputs: Path, kinds: Iterable[str] = REASONS) -> list[GarbageRun]:
    """Find the runs that may be deleted for these REASONS, without runs in progress, noted runs and
    prerequisites."""
    runs = list_runs(outputs)
    orphans, requested = _find_orphans(outputs, runs), set(kinds)
    candidates = {}
    for run in runs:
        kind, reason = _find_deletion_reason(run, orphans)
        if kind in requested and not _has_notes(run) and run.state(False) != "running":
            size = sum(path.stat().st_size for path in run.folder.rglob("*") if path.is_file())
            candidates[run.id] = GarbageRun(run, kind, reason, size)
    while candidates.keys() & (used := _list_prerequisites(run for run in runs if run.id not in candidates)):
        candidates = {run_id: one for run_id, one in candidates.items() if run_id not in used}
    return list(candidates.values())


def delete_garbage(garbage_run: GarbageRun) -> bool:
    """Delete a run's folder. Returns False if the run is in use, or has tags or a note."""
    run = garbage_run.run
    with run.lock(wait=False) as lease:
        if lease and not _has_notes(run):
            _remove(run)
    return not run.folder.exists()


def _remove(run: Run) -> None:
    run.reset()  # removes the marker first
    shutil.rmtree(run.folder)


def list_dependents(outputs: Path, run: Run) -> list[str]:
    """Return a line for each run that was trained from this run, and for each sweep or search with it."""
    trained_from_it = [one for one in list_runs(outputs) if one.manifest.get("prerequisite") == run.id]
    plans = [path for path in _list_plans(outputs) if run.id in _read_planned_ids(path)]
    return [
        *(f"run {one.id} was trained from it" for one in trained_from_it),
        *(f"sweep {path.parent.name} contains it" for path in plans),
    ]


def delete_run(outputs: Path, run: Run, by: str = "command line") -> None:
    """Delete a run's folder, and log it in the outputs folder. Raises InputError if the run is in use."""
    with run.lock(wait=False) as lease:
        if not lease:
            raise InputError(f"run {run.id}: must not be in use; stop it first: memmlp runs stop {run.id}")
        _remove(run)
    log_action(outputs, "delete", run.id, by)


def _list_prerequisites(runs: Iterable[Run]) -> set[str | None]:
    return {run.manifest.get("prerequisite") for run in runs}


def _find_deletion_reason(run: Run, orphans: Mapping[str, str]) -> tuple[str, str]:
    if run.failure and not run.done:  # a trained run may have failed only in an export
        return "failed", run.failure
    if changed := list_outdated(
        {**collect_prerequisite_versions(run.manifest), **(run.manifest.get("component_versions") or {})}
    ):
        return "old", f"older version: {', '.join(changed)}"
    return ("orphaned", orphans[run.id]) if run.id in orphans else ("", "")


def _find_orphans(outputs: Path, runs: list[Run]) -> dict[str, str]:
    """Return why runs are orphans, by id: an unused prerequisite run, or a run that never started."""
    planned = {run_id for path in _list_plans(outputs) for run_id in _read_planned_ids(path)}
    used = _list_prerequisites(runs) | planned
    kinds = {run.id: str(run.manifest.get("kind") or NETWORK) for run in runs}
    unused = [run_id for run_id, kind in kinds.items() if kind != NETWORK and run_id not in used]
    empty = [run for run in runs if not (run.manifest or run.damage or run.is_stop_requested)]
    reasons = {run_id: f"no run uses this {describe_kind(kinds[run_id])}" for run_id in unused}
    return reasons | {run.id: "an empty folder" for run in empty}


def _list_plans(outputs: Path) -> Iterator[Path]:
    yield from outputs.glob("sweeps/*/plan.json")
    for path in outputs.glob("*/*/controllers/*.process"):
        if (process := read_json(path)) and is_alive(process) is not False:
            yield path.with_suffix(".json")


def _read_planned_ids(path: Path) -> set[str]:
    tasks = read_json(path).get("tasks")
    ids = [one.get("id") for one in tasks if isinstance(one, dict)] if isinstance(tasks, list) else []
    return {one for one in ids if isinstance(one, str)}


def _has_notes(run: Run) -> bool:
    notes = read_notes(run)
    return bool(notes.tags or notes.note)
