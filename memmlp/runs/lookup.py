"""Finding runs below an outputs folder."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.runs.identity import ID
from memmlp.runs.run import Run


def list_runs(outputs: Path | str) -> list[Run]:
    """Return the runs below an outputs folder, the newest first."""
    folders = sorted((Path(outputs) / "runs").glob("*/"))
    runs = [Run(folder) for folder in folders if ID.fullmatch(folder.name)]
    return sorted(runs, key=lambda run: str(run.manifest.get("started", "")), reverse=True)


def find_run(outputs: Path | str, name: str) -> Run:
    """Find a run by its id, the beginning of its id, or its folder.

    Raises:
        InputError: if no run or more than one fits.
    """
    if name and ("/" in name or not ID.fullmatch(name)) and (Path(name) / "manifest.json").is_file():
        return Run(Path(name).resolve())
    known = list_runs(outputs)
    matches = [run for run in known if name and run.id.startswith(name)]
    if len(matches) == 1:
        return matches[0]
    where = Path(outputs) / "runs"
    if not matches and name and (Path(name) / "manifest.json").is_file():
        return Run(Path(name).resolve())
    if not matches:
        raise InputError(
            f"run '{name}': no such folder, and the id of none of the {len(known)} runs in {where} begins so "
            "(memmlp runs list)"
        )
    ids = _enumerate(sorted(run.id for run in matches))
    raise InputError(f"run '{name}': {len(matches)} ids begin so: {ids}")


def is_trained(run: Run) -> bool:
    """Return whether a run is a finished run of a motion network, not one of a VQ-VAE."""
    return run.done and run.manifest.get("kind") == "memmlp"


def check_trained(run: Run) -> None:
    """Raise InputError if a run is not a finished run of a motion network."""
    if not is_trained(run):
        raise InputError(f"run {run.id}: not a finished run of a motion network")


def _enumerate(names: Iterable[str], most: int = 8) -> str:
    """Join names with commas; after the first `most` names the rest is left out."""
    every = list(names)
    return ", ".join(every[:most]) + (", ..." if len(every) > most else "")
