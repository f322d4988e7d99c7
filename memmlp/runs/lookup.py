"""Finds and describes runs below an outputs folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.runs.identity import ID, NETWORK
from memmlp.runs.run import Run

MINUTE = 60 * 60  # frames at 60 Hz
LITTLE = 30 * MINUTE  # a twenty-third of what `profile=small` draws


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
    is_folder = bool(name) and (Path(name) / "manifest.json").is_file()
    if is_folder and ("/" in name or not ID.fullmatch(name)):
        return Run(Path(name).resolve())
    known = list_runs(outputs)
    matches = sorted(run.id for run in known if name and run.id.startswith(name))
    if len(matches) == 1:
        return Run.of(outputs, matches[0])
    if matches:
        shown = ", ".join(matches[:8]) + (", ..." if len(matches) > 8 else "")
        raise InputError(f"run '{name}': {len(matches)} ids begin with it: {shown}")
    if is_folder:
        return Run(Path(name).resolve())
    where = Path(outputs) / "runs"
    raise InputError(f"run '{name}': no such folder, and no id of {len(known)} runs in {where} begins so")


def is_trained(run: Run) -> bool:
    """Return whether a run is a finished run of a motion network, not one of a VQ-VAE."""
    return run.done and run.manifest.get("kind") == NETWORK


def check_trained(run: Run) -> None:
    """Raise InputError if a run is not a finished run of a motion network."""
    if not is_trained(run):
        raise InputError(f"run {run.id}: must be a finished run of a motion network")


def kind_words(kind: str) -> str:
    """Return the readable name of a prerequisite run's kind, such as "lower codes"."""
    return "VQ-VAE" if kind == "vqvae" else kind.replace("_", " ")


def run_name(manifest: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """Return the name that a run got when it began, which tells how its config differs from the default.

    Args:
        manifest: the run's manifest.
        config: the run's config, by dotted key, for a run without a name.
    """
    seed = "" if config.get("seed") is None else f" · seed {config['seed']}"
    return str(manifest.get("name") or kind_words(str(manifest.get("kind") or "run")) + seed)


def frames_seen(run: Run) -> float:
    """Return how many frames a run's network saw in all training steps together; 0 if that is unknown.

    For a refiner, this includes the frames that the network before it saw, and the pieces of its own
    training.
    """
    config = run.config
    refiner, optim, model = (config.get(name) or {} for name in ("refiner", "optim", "model"))
    length = (refiner or model).get("frames") or 0
    seen = float((optim.get("steps") or 0) * (optim.get("batch") or 0) * length)
    if not refiner:
        return seen
    before = frames_seen(Run(run.folder.parent / str(run.manifest.get("prerequisite"))))
    return seen + before if seen and before else 0.0


def hardly_trained(frames: float) -> str:
    """Return a warning if a network saw less than half an hour of motion in training; empty otherwise.

    Args:
        frames: how many frames it saw, as `frames_seen` counts them; 0 if that is unknown.
    """
    if not 0 < frames < LITTLE:
        return ""
    return f"hardly trained (its steps saw {frames / MINUTE:.2g} minutes of motion): ignore its errors"
