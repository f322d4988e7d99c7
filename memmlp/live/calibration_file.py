"""What a stream knows of its wearer, as a JSON file: the joints' offsets from the devices, height, floor."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError, why_unreadable
from memmlp.common.files import write_json
from memmlp.live.spaces import SpaceName, space_of
from memmlp.live.stream import Offsets, checked_offsets

LARGEST = 100_000  # bytes of a file
SAME = 5e-3  # metres by which two bodies of a height may differ


@dataclass(frozen=True)
class Calibration:
    """What a stream must know of a wearer; all fields except `body` are arguments of `Stream`.

    Attributes:
        space: the frame of reference, in whose axes the offsets are.
        body: the body height of the network for which the offsets were found, metres
            (`memmlp.live.wearer.stature`).
        offsets: the offsets of the joints from the devices; None for none.
        height: the body height, metres, of which the offsets are; None for the height of the network's body.
        floor: the height of the floor, metres.
    """

    space: SpaceName
    body: float
    offsets: Offsets | None = None
    height: float | None = None
    floor: float = 0.0


def save_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration, atomically.

    Raises:
        InputError: if the file cannot be written.
    """
    offsets = calibration.offsets and {
        "positions": calibration.offsets.positions.tolist(),
        "rotations": calibration.offsets.rotations.tolist(),
    }
    words = {
        "space": calibration.space,
        "body": calibration.body,
        "height": calibration.height,
        "floor": calibration.floor,
    }
    try:
        write_json(path, {"memmlp": "calibration", **words, "offsets": offsets})
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); allowed: a file to write") from error


def read_calibration(path: Path, space: SpaceName, body: float) -> Calibration:
    """Read a calibration, for a frame of reference and a network with a given body height (metres).

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
        if abs(fields["body"] - body) > SAME:
            raise InputError(
                f"of a network's body of {fields['body']:.2f} m, and this one's has {body:.2f} m"
            )
        return Calibration(space, body, offsets, fields["height"], fields["floor"])
    except (KeyError, TypeError, InputError) as error:
        raise InputError(f"{path}: cannot be used ({error}); allowed is {MADE}") from None


MADE = "a file that memmlp live --calibration wrote"


def _offsets(fields: dict[str, Any] | None) -> Offsets | None:
    if fields is None:
        return None
    return checked_offsets(Offsets(fields["positions"], fields["rotations"]))
