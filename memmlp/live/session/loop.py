"""The loop of `memmlp live`: samples go from a source through the stream to outputs and to open pages."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from memmlp.common.errors import InputError
from memmlp.live.outputs.output import Outputs
from memmlp.live.rotations import matrix_to_quaternion
from memmlp.live.sample_warnings import OddSamples
from memmlp.live.session.sources import TrackerSource
from memmlp.live.session.wearer_fitting import Fitting
from memmlp.live.spaces import SPACES, Space
from memmlp.live.stream import Pose, Stream
from memmlp.motion.body import FPS, JOINTS, PARENTS, ROOT
from memmlp.motion.formats.vrm import VRM_BONES as VRM
from memmlp.motion.limb_shapes import HEAT, LIMBS

PAGE_SPACE = SPACES["openxr"]  # the page's axes: those of three.js
TOP = 20  # cm at the top of the page's colour scale
UNIT = 10_000  # whole numbers that a quaternion's 1 is sent as

Publish = Callable[[dict[str, Any]], None]


def greeting(
    source: TrackerSource, network: str, outputs: Outputs | None = None, remark: str = ""
) -> dict[str, Any]:
    """Return the message that a page gets before the first frame.

    Args:
        source: where the trackers' samples come from.
        network: the network's name.
        outputs: where poses go beside the page.
        remark: what people should know who see the network move, such as that it is hardly trained.
    """
    limbs = [{"start": a, "end": b, "radii": radii, "tip": tip} for a, b, radii, tip in LIMBS]
    words = {"network": network, "remark": remark, "source": source.name, "fps": FPS, "joints": JOINTS}
    words |= {"outputs": [output.name for output in outputs.outputs] if outputs else []}
    return words | {"limbs": limbs, "heat": HEAT, "top": TOP, "worn": source.worn}


def with_avatar(words: Mapping[str, Any]) -> dict[str, Any]:
    """Return a greeting with an avatar's bones added."""
    return dict(words) | {"avatar": {"bones": VRM, "parents": PARENTS, "unit": UNIT}}


def run_loop(
    stream: Stream,
    source: TrackerSource,
    publish: Publish,
    stopped: threading.Event,
    outputs: Outputs | None = None,
    fitting: Fitting | None = None,
    avatar: bool = False,
    tell: Callable[[str], None] = lambda line: None,
) -> None:
    """Feed samples to the stream, and its frames to the outputs and to open pages, until `stopped` is set.

    A message has the frame's number and time (s); the milliseconds that the exported step took (`ms`), and
    those that passed from the sample's arrival until all outputs had the pose (`whole`); how many
    samples were dropped, malformed, or foreign so far; whether the samples' times jump (`OddSamples`); the
    trackers that are held; and the joints' positions, predicted and true (66 whole millimetres each, in
    openxr's axes).
    Packets that are not taken are reported at once, by a message with these counts alone.

    Args:
        stream: the stream of poses; its network is `stream.network`.
        source: gives the samples.
        publish: gets the messages.
        stopped: ends the loop.
        outputs: get the frames first.
        fitting: fits the stream to its wearer between the samples.
        avatar: whether messages have what an avatar needs as well (`avatar_message`).
        tell: gets a line if samples are odd (`OddSamples`), or the first time that one is refused.
    """
    stream.odd = OddSamples(tell)
    number, refused, dropped, told = 0, 0, 0, (0, 0)
    while not stopped.is_set():
        sample = source.read()
        if fitting:
            fitting.step(sample and sample.trackers)
        if (source.malformed + refused, source.foreign) != told:
            told = source.malformed + refused, source.foreign
            publish(refusals_message(dropped, *told))
        if sample is None:
            continue
        dropped += sample.dropped
        arrived = sample.arrived or time.perf_counter()
        try:
            pose = stream.step(*sample.trackers, time=sample.time)
        except InputError as error:
            refused += 1
            if refused == 1:
                tell(f"a sample is not taken: {error}")
            continue
        if not pose.fresh:
            continue
        if outputs:
            outputs.take(stream, pose)
        whole = 1000 * (time.perf_counter() - arrived)
        times = {"ms": round(1000 * stream.step_seconds, 3), "whole": round(whole, 3)}
        told = source.malformed + refused, source.foreign
        opening = {
            "number": number,
            "time": round(pose.time, 4),
            "held": pose.held,
            "jumping": stream.odd.jumping,
        }
        message = (
            opening
            | times
            | refusals_message(dropped, *told)
            | positions_message(stream.space, pose, source.truth(pose.time))
        )
        publish(message | (avatar_message(stream.space, pose, stream.rest) if avatar else {}))
        number += 1


def refusals_message(dropped: int, malformed: int, foreign: int) -> dict[str, Any]:
    """Return the part of a message about samples that were not taken."""
    return {"dropped": dropped, "malformed": malformed, "foreign": foreign}


def positions_message(space: Space, pose: Pose, truth: np.ndarray | None) -> dict[str, Any]:
    """Return the part of a message with the joints' positions."""
    return {"positions": millimetres(space, pose.positions), "truth": millimetres(space, truth)}


def millimetres(space: Space, joints: np.ndarray | None) -> list[int] | None:
    """Return joints (22, 3) of a space, in metres, as a flat list of whole millimetres in the page's axes."""
    if joints is None:
        return None
    positions = PAGE_SPACE.positions_out(space.positions_in(np.asarray(joints, np.float64)))
    return (1000 * positions).round().astype(int).ravel().tolist()


def avatar_message(space: Space, pose: Pose, rest: np.ndarray) -> dict[str, Any]:
    """Return the part of a message for an avatar: the joints' rotations, and the wearer's hips, metres.

    The rotations are 22 quaternions xyzw as 88 whole numbers, relative to VRM's T-pose, which is SMPL's: Y
    up, facing +Z. The root's is in the page's axes. The height of the hips in the rest pose (22, 3), metres,
    gives the avatar its size; the wearer may change it on the page at any time.
    """
    local = space.pose_in(pose.rotations)
    local[0] = PAGE_SPACE.world.T @ local[0]
    turns = (UNIT * matrix_to_quaternion(local)).round().astype(int).ravel().tolist()
    return {"turns": turns, "hips": round(hips_height(rest), 4)}


def hips_height(rest: np.ndarray) -> float:
    """Return the height of the hips above the lowest joint, in a rest pose (22, 3), metres."""
    return float(rest[ROOT, 1] - rest[:, 1].min())
