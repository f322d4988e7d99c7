"""A sweep kept beside its plan, so that its table can be shown without its file and without composing it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.files import plain, read_json, write_json
from memmlp.runs.former_keys import with_present_keys
from memmlp.sweep.definition import Arm, Scale, Sweep

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
        if "extra" in content:  # what earlier versions called it
            content["command_line"] = content.pop("extra")
        base, typed, arms = content["base"], content["command_line"], content["arms"]
        own = [word for arm in arms for word in arm["overrides"] or ()]
        content["arms"] = tuple(_arm(fields, beside=(*base, *typed)) for fields in arms)
        content["base"] = with_present_keys(base, beside=(*own, *typed))
        content["command_line"] = with_present_keys(typed, beside=(*own, *base))
        content["scale"] = _scale(content["scale"]) if content.get("scale") else None
        return Sweep(**_with_tuples(content, ("notes", "base", "seeds", "arms", "metrics", "command_line")))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not a sweep ({error}); start the sweep again") from None


def _arm(fields: dict[str, Any], beside: Sequence[str]) -> Arm:
    """Return a kept arm; `beside` are the overrides of every arm of its sweep."""
    named = {name: fields[name] for name in ("overrides", "cell") if fields.get(name)}
    words = {name: with_present_keys(own, beside) for name, own in named.items()}
    return Arm(**_with_tuples(fields | words, ("overrides", "seeds", "cell")))


def _scale(fields: dict[str, Any]) -> Scale:
    named = {"along" if name == "against" else name: value for name, value in fields.items()}
    return Scale(**_with_tuples(named, ("along", "predict")))  # `against` up to version 0.2


def _with_tuples(fields: dict[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    """Return the fields, some of them turned back from lists, as JSON has them, into tuples."""
    return {**fields, **{name: tuple(fields[name]) for name in names if fields.get(name) is not None}}
