"""The body that clips were imported onto, with which they must be used: their feet stand at its floor."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.files import digest
from memmlp.motion.body import builtin_rest_joints

RECORD = "import.json"
"""What an import leaves in its folder."""

BODY_KEYS = ("body", "rest_joints", "joints")
"""What of it tells of the body."""


def body_record(body: str, rest: np.ndarray) -> dict[str, Any]:
    """Return what an import records of its body: its name, a digest of its rest joints, and these joints.

    Args:
        body: `builtin`, or the path of an SMPL-H model.
        rest: its rest joints (22, 3), metres.
    """
    return {"body": Path(body).name, "rest_joints": digest(rest.tolist()), "joints": rest.round(6).tolist()}


def body_name(body: str, rest: np.ndarray) -> str:
    """Return a body's name; a model's includes a digest, since all bodies' model files have the same name.

    Args:
        body: `builtin`, or the path of an SMPL-H model.
        rest: its rest joints (22, 3), metres.
    """
    return "builtin" if body == "builtin" else f"{Path(body).name} {digest(rest.tolist())[:8]}"


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
    for folder, there in _recorded(clips):
        if not there.items() <= here.items():
            raise InputError(
                f"{folder}: was imported onto the body {there.get('body')}; allowed is {key} of the "
                "same, or another import with --body"
            )


def check_networks_body(clips: Iterable[Path], body: str) -> None:
    """Check that clips which memmlp imported are on the body that a network was trained on.

    Args:
        clips: the clips' files.
        body: that body's name (`body_name`).

    Raises:
        InputError: if they were imported onto another.
    """
    for folder, there in _recorded(clips):
        name, joints = there.get("body", body), there.get("rest_joints", "")
        if name != "builtin" and joints:
            name = f"{name} {joints[:8]}"
        if name != body and name != body.rpartition(" ")[0]:
            raise InputError(
                f"{folder}: was imported onto the body {name}, and the network was trained on {body}; "
                "allowed are clips imported onto that body, with --body"
            )


def check_networks_joints(clips: Iterable[Path], rest: np.ndarray) -> None:
    """Check the same of a network of which the body's joints are known, and no name.

    Of earlier imports onto a model, which did not record joints, all that is known is that the built-in body
    is another one.

    Args:
        clips: the clips' files.
        rest: the joints of the network's body in the rest pose (22, 3), metres.

    Raises:
        InputError: if they were imported onto another body.
    """
    builtin = builtin_rest_joints()
    for folder, there in _recorded(clips):
        name = there.get("body")
        joints = builtin if name == "builtin" else there.get("joints")
        same = _are_alike(joints, rest) if joints is not None else not _are_alike(builtin, rest)
        if name is not None and not same:
            raise InputError(
                f"{folder}: was imported onto the body {name}, and the network was trained on another; "
                "allowed are clips imported onto the network's body, with --body"
            )


def _are_alike(one: Any, other: np.ndarray) -> bool:
    """Return whether two bodies have the same joints, to a tenth of a millimetre; networks have float32."""
    try:
        joints = np.asarray(one, np.float64)
    except (ValueError, TypeError):  # a record that somebody has changed
        return False
    return joints.shape == other.shape and bool(np.allclose(joints, other, rtol=0, atol=1e-4))


def _recorded(clips: Iterable[Path]) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield the folders of the imports that the clips are from, each with what it records of its body.

    Of each clip, that is the nearest record above it.
    """
    folders = {clip.parent.resolve() for clip in clips}
    above = ([parent / RECORD for parent in (folder, *folder.parents)] for folder in folders)
    for path in sorted({path for paths in above if (path := next(filter(Path.is_file, paths), None))}):
        try:
            record = json.loads(path.read_text("utf-8"))
            yield path.parent, {key: record[key] for key in BODY_KEYS if key in record}
        except (OSError, ValueError, TypeError):
            continue  # somebody else's file
