"""Fills in what a logger missed, from the folders of runs and sweeps."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

from memmlp.experiment_tracking.follower import ledgers, reason_of
from memmlp.experiment_tracking.logged_values import SweepFacts
from memmlp.experiment_tracking.run_logger import Busy, RunLogger, Session
from memmlp.runs.run import Run

Say = Callable[[str], None]


def sync(logger: RunLogger, runs: Iterable[Run], outputs: Path, say: Say, full: bool = False) -> Counter[str]:
    """Update a logger, so that it has exactly the content of each run's folder.

    Args:
        logger: the logger.
        runs: the runs.
        outputs: the outputs folder.
        say: gets a line about each run that could not be shown.
        full: whether runs that the logger has according to our notes are shown anew, too.

    Returns:
        How many runs were "shown", were up to date ("same"), are being followed at present ("live"), or
        "failed".
    """
    found: Counter[str] = Counter()
    for run in runs:
        try:
            found[_one(logger, run, outputs, full)] += 1
        except Busy:
            found["live"] += 1
        except Exception as error:
            found["failed"] += 1
            say(f"run {run.id} is not shown by {logger.name}: {reason_of(error)}")
    return found


def _one(logger: RunLogger, run: Run, outputs: Path, full: bool) -> str:
    session = Session(logger, run, ledgers(outputs, logger))
    try:
        if run.doing:
            return "live"
        if not full and session.up_to_date():
            return "same"
        session.end()
        return "shown"
    finally:
        session.leave()


def sync_sweeps(logger: RunLogger, folders: Iterable[Path], say: Say) -> int:
    """Show the sweeps whose folders have a summary, and return how many were shown."""
    shown = 0
    for folder in folders:
        facts = SweepFacts.read(folder)
        if facts is None:
            continue
        try:
            logger.sweep(facts)
            shown += 1
        except Exception as error:
            say(f"sweep {facts.name} is not shown by {logger.name}: {reason_of(error)}")
    return shown
