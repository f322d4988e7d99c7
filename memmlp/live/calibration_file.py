"""What a stream knows of its wearer, as a JSON file: the joints' offsets from the devices, height, floor."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from memmlp.common.errors import InputError, why_unreadable
from memmlp.common.files import write_json
from memmlp.live.rotations import BodyTree
from memmlp.live.spaces import SpaceName, space_of
from memmlp.live.stream import Offsets, checked_offsets
from memmlp.live.wearer import stature

LARGEST = 100_000  # bytes of a file
SAME = 5e-3  # metres by which two bodies of a height may differ


@dataclass(frozen=True)
class Calibration:
    """What a stream must know of a wearer; the fields are arguments of `Stream`.

    Attributes:
        space: the frame of reference, in whose axes the offsets are.
        offsets: the offsets of the joints from the devices; None for none.
        height: the body height, metres, of which the offsets are; None for the height of the network's body.
        floor: the height of the floor, metres.
    """

    space: SpaceName
    offsets: Offsets | None = None
    height: float | None = None
    floor: float = 0.0


def save_calibration(path: Path, calibration: Calibration, body: BodyTree) -> None:
    """Write a calibration, atomically.

    Args:
        path: the file.
        calibration: what it shall hold.
        body: the network's body, of which the offsets are.

    Raises:
        InputError: if the file cannot be written.
    """
    offsets = calibration.offsets and {
        "positions": calibration.offsets.positions.tolist(),
        "rotations": calibration.offsets.rotations.tolist(),
    }
    words = {
        "space": calibration.space,
        "body": stature(body),
        "joints": tracked_joints(body).tolist(),
        "height": calibration.height,
        "floor": calibration.floor,
    }
    try:
        write_json(path, {"memmlp": "calibration", **words, "offsets": offsets})
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); allowed: a file to write") from error


def read_calibration(path: Path, space: SpaceName, body: BodyTree) -> Calibration:
    """Read a calibration, for a frame of reference and a network's body.

    Raises:
        InputError: if the file is no calibration, is for another frame of reference, or is for a network with
            another body; the message names the file. Height and floor are not checked here, but where they
            are used.
    """
    try:
        with open(path, "rb") as file:
            fields = json.loads(file.read(LARGEST))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: no calibration ({why_unreadable(error)}); allowed is {MADE}") from None
    if not isinstance(fields, dict) or fields.get("memmlp") != "calibration":
        raise InputError(f"{path}: no calibration; allowed is {MADE}")
    if fields.get("space") != space_of(space).name:
        raise InputError(f"{path}: of --space {fields.get('space')}; allowed with it is that, not {space}")
    try:
        offsets = _offsets(fields["offsets"])
        _check_body(fields, body)
        return Calibration(space, offsets, fields["height"], fields["floor"])
    except (KeyError, TypeError, ValueError, InputError) as error:
        raise InputError(f"{path}: cannot be used ({error}); allowed is {MADE}") from None


def _check_body(fields: dict[str, Any], body: BodyTree) -> None:
    """Refuse offsets of another body, of another height or with the same height and other arms."""
    own = stature(body)
    if abs(fields["body"] - own) > SAME:
        raise InputError(f"of a network's body of {fields['body']:.2f} m, and this one's has {own:.2f} m")
    joints = np.asarray(fields.get("joints", tracked_joints(body)), float)  # older files have none
    away = np.linalg.norm(joints.reshape(3, 3) - tracked_joints(body), axis=-1).max()
    if not away <= SAME:
        raise InputError(
            f"of a network whose body has its head or wrists {100 * away:.1f} cm elsewhere than this one's"
        )


def tracked_joints(body: BodyTree) -> np.ndarray:
    """Return the rest positions (3, 3) of head and wrists relative to their mean, metres.

    A calibration's offsets hold for a body with these positions alone.
    """
    joints = body.rest[body.tracked]
    return joints - joints.mean(0)


MADE = "a file that memmlp live --calibration wrote"


def _offsets(fields: dict[str, Any] | None) -> Offsets | None:
    if fields is None:
        return None
    return checked_offsets(Offsets(fields["positions"], fields["rotations"]))
