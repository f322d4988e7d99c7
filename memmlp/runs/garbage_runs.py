"""Runs that are no longer needed: failed ones, ones with older component versions, and orphans."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from memmlp.common.files import read_json
from memmlp.common.lease import is_alive
from memmlp.runs.environment import prerequisite_versions
from memmlp.runs.identity import NETWORK, outdated
from memmlp.runs.lookup import describe_kind, list_runs, read_notes
from memmlp.runs.run import Run

REASONS = ("failed", "old", "orphaned")


class Garbage(NamedTuple):
    """A run that may be deleted.

    Attributes:
        run: the run.
        kind: one of REASONS.
        reason: why it may be deleted.
        size: bytes in its folder.
    """

    run: Run
    kind: str
    reason: str
    size: int


def garbage(outputs: Path, kinds: Iterable[str] = REASONS) -> list[Garbage]:
    """Find the runs that may be deleted.

    Runs in progress, runs with a tag or a note, and runs that a remaining run needs are never among them.

    Args:
        outputs: the outputs folder.
        kinds: which of REASONS to look for.
    """
    runs = list_runs(outputs)
    orphans, wanted = _orphans(outputs, runs), set(kinds)
    found = {}
    for run in runs:
        kind, reason = _reason(run, orphans)
        if kind in wanted and not _marked(run) and run.state(False) != "running":
            found[run.id] = Garbage(run, kind, reason, _size(run.folder))
    while found.keys() & (used := {run.manifest.get("prerequisite") for run in runs if run.id not in found}):
        found = {run_id: one for run_id, one in found.items() if run_id not in used}
    return list(found.values())


def delete(one: Garbage) -> bool:
    """Delete a run's folder, its marker first. Returns False if the run is in use, or has tags or a note."""
    with one.run.lock(wait=False) as mine:
        if not mine or _marked(one.run):
            return False
        one.run.reset()
        shutil.rmtree(one.run.folder)
    return True


def _reason(run: Run, orphans: Mapping[str, str]) -> tuple[str, str]:
    if run.failure and not run.done:  # a trained run may have failed only in an export
        return "failed", run.failure
    if changed := outdated(
        {**prerequisite_versions(run.manifest), **(run.manifest.get("component_versions") or {})}
    ):
        return "old", f"older version: {', '.join(changed)}"
    return ("orphaned", orphans[run.id]) if run.id in orphans else ("", "")


def _orphans(outputs: Path, runs: list[Run]) -> dict[str, str]:
    """Return the orphans' ids, each with the reason why it is an orphan.

    Orphans are VQ-VAEs and parts that no run uses and no plan contains, and folders of runs that never
    started.
    """
    planned = {task["id"] for path in _plans(outputs) for task in _listed(path, "tasks")}
    used = {run.manifest.get("prerequisite") for run in runs} | planned
    kinds = {run.id: str(run.manifest.get("kind") or NETWORK) for run in runs}
    alone = [run_id for run_id, kind in kinds.items() if kind != NETWORK and run_id not in used]
    empty = [run for run in runs if not run.manifest]
    found = {run_id: f"a {describe_kind(kinds[run_id])} that no run uses" for run_id in alone}
    return found | {run.id: "an empty folder" for run in empty}


def _plans(outputs: Path) -> Iterator[Path]:
    """Yield the plan files of sweeps, and those on which a living process, such as a search, works."""
    yield from outputs.glob("sweeps/*/plan.json")
    for path in outputs.glob("*/*/controllers/*.process"):
        if (process := read_json(path)) and is_alive(process) is not False:
            yield path.with_suffix(".json")


def _listed(path: Path, key: str) -> Iterator[Mapping[str, Any]]:
    found = read_json(path).get(key)
    yield from (one for one in found or () if isinstance(one, dict) and "id" in one)


def _marked(run: Run) -> bool:
    """Return whether the run has a tag or a note."""
    notes = read_notes(run)
    return bool(notes.tags or notes.note)


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
