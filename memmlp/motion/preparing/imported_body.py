"""The body that clips were imported onto, on which they must be prepared: their feet stand at its floor."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.files import digest
from memmlp.motion.preparing.several_folders import Folders, Root

RECORD = "import.json"
"""What an import leaves in its folder."""


def body_record(body: str, rest: np.ndarray) -> dict[str, str]:
    """Return what an import records of its body.

    Args:
        body: `builtin`, or the path of an SMPL-H model.
        rest: its rest joints (22, 3), metres.
    """
    return {"body": Path(body).name, "rest_joints": digest(rest.tolist())}


def check_imported_body(root: Root, body: str, rest: np.ndarray) -> None:
    """Check that clips which memmlp imported are prepared on the body that they were imported onto.

    On another one the floor lies elsewhere, by centimetres.

    Args:
        root: where the clips are.
        body: `builtin`, or the path of an SMPL-H model.
        rest: its rest joints (22, 3), metres.

    Raises:
        InputError: if they were imported onto another.
    """
    here = body_record(body, rest)
    for path in _records(root):
        try:
            record = json.loads(path.read_text("utf-8"))
            there = {key: record[key] for key in here if key in record}
        except (OSError, ValueError, TypeError):
            continue  # somebody else's file
        if not there.items() <= here.items():
            raise InputError(
                f"{path.parent}: was imported onto the body {there.get('body')}; allowed is data.body of the "
                "same, or another import with --body"
            )


def _records(root: Root) -> Iterator[Path]:
    for folder in root.sources.values() if isinstance(root, Folders) else [root]:
        yield from (path for path in (folder / RECORD, *folder.glob(f"*/{RECORD}")) if path.is_file())
