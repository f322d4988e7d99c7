"""The body that clips were imported onto, with which they must be used: their feet stand at its floor."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.files import digest

RECORD = "import.json"
"""What an import leaves in its folder."""


def body_record(body: str, rest: np.ndarray) -> dict[str, str]:
    """Return what an import records of its body.

    Args:
        body: `builtin`, or the path of an SMPL-H model.
        rest: its rest joints (22, 3), metres.
    """
    return {"body": Path(body).name, "rest_joints": digest(rest.tolist())}


def check_imported_body(clips: Iterable[Path], body: str, rest: np.ndarray, key: str = "data.body") -> None:
    """Check that clips which memmlp imported are used with the body that they were imported onto.

    On another one the floor lies elsewhere, by centimetres.

    Args:
        clips: the clips' files.
        body: `builtin`, or the path of an SMPL-H model.
        rest: its rest joints (22, 3), metres.
        key: the key or option that gave the body.

    Raises:
        InputError: if they were imported onto another.
    """
    here = body_record(body, rest)
    for path in _records(clips):
        try:
            record = json.loads(path.read_text("utf-8"))
            there = {key: record[key] for key in here if key in record}
        except (OSError, ValueError, TypeError):
            continue  # somebody else's file
        if not there.items() <= here.items():
            raise InputError(
                f"{path.parent}: was imported onto the body {there.get('body')}; allowed is {key} of the "
                "same, or another import with --body"
            )


def _records(clips: Iterable[Path]) -> Iterator[Path]:
    """Yield the records of the imports that the clips are from: of each clip, the nearest one above it."""
    folders = {clip.parent.resolve() for clip in clips}
    above = ([parent / RECORD for parent in (folder, *folder.parents)] for folder in folders)
    yield from sorted({path for paths in above if (path := next(filter(Path.is_file, paths), None))})
