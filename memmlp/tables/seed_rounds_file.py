"""The file of a sweep's rounds: what it holds, and whether that is about the runs that there are."""

from __future__ import annotations

import json
from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.common.files import digest
from memmlp.sweep.plan import Plan
from memmlp.sweep.spec import Sweep
from memmlp.tables.seed_rounds import Rounds, of_json, pair_of

NAME = "rounds.json"


def read(path: Path) -> Rounds | None:
    """Read the rounds of a file; None where there is no file. Raises InputError where it is damaged."""
    try:
        return of_json(json.loads(path.read_bytes()))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: no record of rounds ({error}); remove it to begin anew") from None


def name_of(rounds: Rounds, sweep: Sweep, plan: Plan, label: str, seeds: int) -> str:
    """Digest the identities of the first runs, that many seeds, of an arm and its control.

    The identities include the evaluations that the sweep shows of them.
    """
    keys = {(entry.label, entry.seed): entry.key for entry in plan.entries}
    cells = [keys.get((one, seed)) for one in pair_of(sweep, label) for seed in rounds.seeds[:seeds]]
    return digest(cells)[:16]


def same_runs(rounds: Rounds, sweep: Sweep, plan: Plan, path: Path) -> None:
    """Check that past looks compared the very runs that the sweep's arms have now.

    Raises:
        InputError: where a look was of other runs, because data, configs or recipes changed since.
    """
    for taken in rounds.taken:
        for label, name in taken.runs.items():
            if name != name_of(rounds, sweep, plan, label, taken.seeds):
                raise InputError(
                    f"{path}: its looks were taken of other runs of '{label}': data, configs or recipes "
                    "changed since; remove it to begin anew"
                )
