"""Fills in what a tracker missed, from the folders of runs and sweeps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

from memmlp.experiment_tracking.follower import ledgers, reason_of
from memmlp.experiment_tracking.logged_values import SweepFacts
from memmlp.experiment_tracking.tracker import Busy, Session, Tracker
from memmlp.runs.run import Run

Say = Callable[[str], None]


def sync(tracker: Tracker, runs: Iterable[Run], outputs: Path, say: Say, full: bool = False) -> Counter[str]:
    """Update a tracker, so that it has exactly the content of each run's folder.

    Args:
        tracker: the tracker.
        runs: the runs.
        outputs: the outputs folder.
        say: gets a line about each run that could not be shown.
        full: whether runs that the tracker has according to our notes are shown anew, too.

    Returns:
        How many runs were "shown", were up to date ("same"), are being followed at present ("live"), or
        "failed".
    """
    found: Counter[str] = Counter()
    for run in runs:
        try:
            found[_one(tracker, run, outputs, full)] += 1
        except Busy:
            found["live"] += 1
        except Exception as error:
            found["failed"] += 1
            say(f"run {run.id} is not shown by {tracker.name}: {reason_of(error)}")
    return found


def _one(tracker: Tracker, run: Run, outputs: Path, full: bool) -> str:
    session = Session(tracker, run, ledgers(outputs, tracker))
    try:
        if run.doing:
            return "live"
        if not full and session.up_to_date():
            return "same"
        session.end()
        return "shown"
    finally:
        session.leave()


def sync_sweeps(tracker: Tracker, folders: Iterable[Path], say: Say) -> int:
    """Show the sweeps whose folders have a summary, and return how many were shown."""
    shown = 0
    for folder in folders:
        facts = SweepFacts.read(folder)
        if facts is None:
            continue
        try:
            tracker.sweep(facts)
            shown += 1
        except Exception as error:
            say(f"sweep {facts.name} is not shown by {tracker.name}: {reason_of(error)}")
    return shown
