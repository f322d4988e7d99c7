"""Tags and notes that users give a run: the file `notes.json` in its folder, which does not affect its id."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.common.files import read_json, write_json
from memmlp.runs.run import Run

TAG = re.compile(r"[\w.+/:-]{1,64}")
MAX_LENGTH = 10_000  # characters of a note


@dataclass(frozen=True)
class Notes:
    """A run's tags and note.

    Attributes:
        tags: short words, sorted.
        note: a text; empty for none.
    """

    tags: tuple[str, ...] = ()
    note: str = ""


def notes_path(run: Run) -> Path:
    """Return the file of a run's tags and note."""
    return run.folder / "notes.json"


def read_notes(run: Run) -> Notes:
    """Return a run's tags and note; empty ones if there are none or the file is damaged."""
    found = read_json(notes_path(run))
    tags, note = found.get("tags"), found.get("note")
    words = [tag for tag in tags if isinstance(tag, str)] if isinstance(tags, list) else []
    return Notes(tuple(sorted(set(words))), note if isinstance(note, str) else "")


def add_tags(run: Run, tags: Iterable[str]) -> Notes:
    """Add tags to a run. Raises InputError for a tag that is not a short word."""
    known = read_notes(run)
    return _write(run, Notes(tuple(sorted({*known.tags, *map(_checked, tags)})), known.note))


def remove_tags(run: Run, tags: Iterable[str]) -> Notes:
    """Remove tags from a run. Raises InputError for a tag that the run does not have."""
    known, gone = read_notes(run), set(tags)
    if missing := sorted(gone - set(known.tags)):
        has = ", ".join(known.tags) or "none"
        raise InputError(f"tag '{missing[0]}': run {run.id} does not have it; its tags: {has}")
    return _write(run, Notes(tuple(tag for tag in known.tags if tag not in gone), known.note))


def set_note(run: Run, note: str) -> Notes:
    """Replace a run's note; an empty one removes it. Raises InputError for one that is too long."""
    if len(note) > MAX_LENGTH:
        raise InputError(f"note: must have at most {MAX_LENGTH} characters, not {len(note)}")
    return _write(run, Notes(read_notes(run).tags, note.strip()))


def _checked(tag: str) -> str:
    if not TAG.fullmatch(tag):
        raise InputError(f"tag '{tag}': must be up to 64 letters, digits and . _ + / : -")
    return tag


def _write(run: Run, notes: Notes) -> Notes:
    write_json(notes_path(run), {"tags": list(notes.tags), "note": notes.note})
    return notes
