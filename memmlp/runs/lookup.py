"""Finding runs below an outputs folder, and comparing two of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from memmlp.common.errors import InputError
from memmlp.runs.identity import ID, flatten
from memmlp.runs.run import Run


class Diff(NamedTuple):
    """What differs between two runs: by dotted key both values, "-" where a run has none.

    Attributes:
        config: differences of the configs.
        results: differences of the results.
    """

    config: dict[str, tuple[Any, Any]]
    results: dict[str, tuple[Any, Any]]


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
            f"run '{name}': no such folder, and the id of none of the {len(known)} runs in {where} begins so"
        )
    ids = _enumerate(sorted(run.id for run in matches))
    raise InputError(f"run '{name}': {len(matches)} ids begin so: {ids}")


def is_trained(run: Run) -> bool:
    """Whether it is a finished run of a motion network, not one of a VQ-VAE."""
    return run.done and run.manifest.get("kind") == "memmlp"


def check_trained(run: Run) -> None:
    """Raise InputError where it is no finished run of a motion network."""
    if not is_trained(run):
        raise InputError(f"run {run.id}: not a finished Mem-MLP run")


def _enumerate(names: Iterable[str], most: int = 8) -> str:
    """Join names with commas; of more than `most` only the first are shown."""
    every = list(names)
    return ", ".join(every[:most]) + (", ..." if len(every) > most else "")


def diff(a: Run, b: Run) -> Diff:
    """Compare the configs and results of two runs."""
    return Diff(_differences(a.config, b.config), _differences(a.results, b.results))


def _differences(a: Mapping[str, Any], b: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    flat_a, flat_b = flatten(a), flatten(b)
    pairs = {key: (flat_a.get(key, "-"), flat_b.get(key, "-")) for key in flat_a | flat_b}
    return {key: pair for key, pair in pairs.items() if pair[0] != pair[1]}
