"""The body that clips were imported onto, with which they must be used: their feet stand at its floor."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.files import digest

RECORD = "import.json"
"""The record that an import leaves in its folder."""


def body_record(body: str, rest: np.ndarray) -> dict[str, Any]:
    """Return what an import records of its body.

    Args:
        body: `builtin`, or the path of an SMPL-H model.
        rest: its rest joints (22, 3), metres.
    """
    return {"body": Path(body).name, "joints": rest.round(6).tolist()}


def body_name(body: str, rest: np.ndarray) -> str:
    """Return a body's name; a model's includes a digest, since all bodies' model files have the same name.

    Args:
        body: `builtin`, or the path of an SMPL-H model.
        rest: its rest joints (22, 3), metres.
    """
    return "builtin" if body == "builtin" else f"{Path(body).name} {digest(rest.tolist())[:8]}"


def check_imported_body(clips: Iterable[Path], rest: np.ndarray, user: str) -> None:
    """Check that clips which memmlp imported are used with the body that they were imported onto.

    On another body the floor lies elsewhere, by centimetres. Clips without a record of an import pass.

    Args:
        clips: the clips' files.
        rest: the body's rest joints (22, 3), metres.
        user: the key, option or network that gave the body, for the message.

    Raises:
        InputError: if they were imported onto another body.
    """
    folders = {clip.parent.resolve() for clip in clips}
    above = ([parent / RECORD for parent in (folder, *folder.parents)] for folder in folders)
    for path in sorted({path for paths in above if (path := next(filter(Path.is_file, paths), None))}):
        try:
            record = json.loads(path.read_text("utf-8"))
            body, joints = record["body"], np.asarray(record["joints"], np.float64)
        except (OSError, ValueError, TypeError, KeyError):
            continue  # a file of another program
        # Networks have their joints in float32.
        if joints.shape != rest.shape or not np.allclose(joints, rest, rtol=0, atol=1e-4):
            raise InputError(
                f"{path.parent}: imported onto the body {body}, but {user} has another one; "
                "use the same body, or import again with --body"
            )
