"""A sweep kept beside its plan, so that its table can be shown without its file and without composing it."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.files import plain, read_json, write_json
from memmlp.sweep.definition import Sweep, Variant

NAME = "sweep.json"


def keep_sweep(sweep: Sweep, folder: Path) -> None:
    """Write the sweep into its folder, unless the folder has the same content already."""
    content = plain(asdict(sweep))
    if read_json(folder / NAME) != content:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / NAME, content)


def kept_sweep(folder: Path) -> Sweep | None:
    """Return the sweep kept in a folder; None if there is none. Raises InputError if it is damaged."""
    path = folder / NAME
    if not path.exists():
        return None
    try:
        content = json.loads(path.read_bytes())
        content["variants"] = tuple(
            Variant(**_with_tuples(fields, ("overrides", "seeds", "cell"))) for fields in content["variants"]
        )
        return Sweep(
            **_with_tuples(content, ("notes", "base", "seeds", "variants", "metrics", "command_line"))
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not a sweep ({error}); start the sweep again") from None


def _with_tuples(fields: dict[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    """Return the fields, some of them turned back from lists, as JSON has them, into tuples."""
    return {**fields, **{name: tuple(fields[name]) for name in names if fields.get(name) is not None}}
