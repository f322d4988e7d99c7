"""The file of a sweep's rounds: its content, and the check that it is about the present runs."""

from __future__ import annotations

import json
from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.common.files import digest
from memmlp.sweep.definition import Sweep
from memmlp.sweep.plan import Plan
from memmlp.tables.seed_rounds import Rounds, of_json, pair_of

NAME = "rounds.json"


def read(path: Path) -> Rounds | None:
    """Read the rounds in a file; None if there is no file. Raises InputError if it is damaged."""
    try:
        return of_json(json.loads(path.read_bytes()))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: no record of rounds ({error}); remove it to begin anew") from None


def name_of(rounds: Rounds, sweep: Sweep, plan: Plan, label: str, seeds: int) -> str:
    """Return a digest of the identities of a variant's and its control's runs with the first `seeds` seeds.

    The identities include the evaluations that the sweep shows.
    """
    keys = {(entry.label, entry.seed): entry.key for entry in plan.entries}
    cells = [keys.get((one, seed)) for one in pair_of(sweep, label) for seed in rounds.seeds[:seeds]]
    return digest(cells)[:16]


def same_runs(rounds: Rounds, sweep: Sweep, plan: Plan, path: Path) -> None:
    """Check that past looks compared the same runs that the sweep's variants have now.

    Raises:
        InputError: if a look compared other runs, because data, configs or recipes have changed since.
    """
    for taken in rounds.taken:
        for label, name in taken.runs.items():
            if name != name_of(rounds, sweep, plan, label, taken.seeds):
                raise InputError(
                    f"{path}: its looks were taken of other runs of '{label}': data, configs or recipes "
                    "changed since; remove it to begin anew"
                )
