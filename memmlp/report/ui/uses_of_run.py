"""Finds the sweeps and searches that use a run."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from memmlp.sweep.plan import Plan


def uses_by_run(
    plans: Iterable[Plan], trials: Iterable[tuple[str, int, str]] = ()
) -> dict[str, list[dict[str, Any]]]:
    """Return, by run id, the sweeps that use a run, each with arm and seed, and the searches with trials.

    `trials` are the name of a search, the number of a trial and the id of one of its runs.
    """
    found: dict[str, list[dict[str, Any]]] = {}
    for plan in plans:
        for entry in plan.entries:
            found.setdefault(entry.id, []).append(
                {"sweep": plan.name, "arm": entry.label, "seed": entry.seed}
            )
    for search, number, run_id in trials:
        found.setdefault(run_id, []).append({"search": search, "trial": number})
    return found
