"""The loop of `memmlp live`: samples go from a source through the stream to all who watch."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from memmlp.common.errors import InputError
from memmlp.live.player.sources import PoseSource
from memmlp.live.spaces import SPACES, Space
from memmlp.live.stream import Stream
from memmlp.motion.body import FPS, JOINTS
from memmlp.motion.limbs import LIMBS
from memmlp.render.error_colours import HEAT

SHOWN = SPACES["openxr"]  # the page's axes: those of three.js
TOP = 20  # cm at the top of the page's colour scale

Publish = Callable[[dict[str, Any]], None]


def greeting(source: PoseSource, network: str) -> dict[str, Any]:
    """Return what the page must know before the first frame."""
    limbs = [{"start": a, "end": b, "radii": radii, "tip": tip} for a, b, radii, tip in LIMBS]
    words = {"network": network, "source": source.name, "fps": FPS, "joints": JOINTS}
    return words | {"limbs": limbs, "heat": HEAT, "top": TOP}


def play(stream: Stream, source: PoseSource, publish: Publish, stopped: threading.Event) -> None:
    """Feed each sample to the stream and publish the frames, until `stopped` is set.

    A message has the frame's number and time (s), the step's time (ms), how many samples were dropped or
    malformed so far, the trackers that are held, and the joints, predicted and true (66 whole millimetres,
    axes of openxr). Malformed packets are reported at once, by a message that has the counts alone.
    """
    space, number, dropped, refused = SPACES[source.space], 0, 0, 0
    counts = {"dropped": 0, "malformed": 0}
    while not stopped.is_set():
        sample = source.read()
        if source.malformed + refused != counts["malformed"]:
            counts = {"dropped": dropped, "malformed": source.malformed + refused}
            publish(counts)
        if sample is None:
            continue
        dropped += sample.dropped
        began = time.perf_counter()
        try:
            pose = stream.step(*sample.trackers, time=sample.time)
        except InputError:
            refused += 1
            continue
        spent = 1000 * (time.perf_counter() - began)
        if not pose.fresh:
            continue
        truth = source.truth(pose.time)
        message = {"number": number, "time": round(pose.time, 4), "ms": round(spent, 3), "held": pose.held}
        counts = {"dropped": dropped, "malformed": source.malformed + refused}
        joints = {"joints": millimetres(space, pose.positions), "truth": millimetres(space, truth)}
        publish(message | counts | joints)
        number += 1


def millimetres(space: Space, joints: np.ndarray | None) -> list[int] | None:
    """Return joints (22, 3) of a space, in metres, as a flat list of whole millimetres in the page's axes."""
    if joints is None:
        return None
    shown = SHOWN.positions_out(space.positions_in(np.asarray(joints, np.float64)))
    return (1000 * shown).round().astype(int).ravel().tolist()
