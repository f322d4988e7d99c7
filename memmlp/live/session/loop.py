"""The loop of `memmlp live`: samples go from a source through the stream to outputs and to open pages.

Between the samples it carries out the page's orders, which fit the stream to its wearer. They arrive in the
server's threads. The wearer has to walk away from the keyboard before a calibration, so it waits for a
countdown.
"""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from memmlp.common.errors import InputError
from memmlp.live.outputs import Outputs
from memmlp.live.rotations import matrix_to_quaternion
from memmlp.live.session.sources import QuaternionPoses, TrackerSource
from memmlp.live.spaces import SPACES, SpaceName
from memmlp.live.stream import FORGOTTEN, BodyFrame, Stream, raise_by
from memmlp.live.tracker_input import OddSamples
from memmlp.live.wearer import Calibration, save_calibration
from memmlp.motion.body import FPS, JOINTS, PARENTS, ROOT
from memmlp.motion.formats.gltf import VRM_BONES
from memmlp.motion.limb_shapes import HEAT, LIMBS

PAGE_SPACE = SPACES["openxr"]  # the page's axes: those of three.js
TOP = 20  # cm at the top of the page's colour scale
UNIT = 10_000  # whole numbers that a quaternion's 1 is sent as
COUNTDOWN = 5.0  # seconds
LONGEST = 60.0  # seconds of a countdown
ACTIONS = ("calibrate", "touch_floor", "height", "floor", "forget", "cancel")

Publish = Callable[[dict[str, Any]], None]
PublishState = Callable[[str, Mapping[str, Any]], None]


def make_greeting(
    source: TrackerSource,
    network: str,
    outputs: Outputs | None = None,
    remark: str = "",
    avatar: bool = False,
) -> dict[str, Any]:
    """Return the message that a page gets before the first frame.

    Args:
        source: where the trackers' samples come from.
        network: the network's name.
        outputs: the other receivers of poses.
        remark: a warning about the network, such as that it is hardly trained.
        avatar: whether the page shows an avatar, whose bones it needs.
    """
    return {
        "network": network,
        "remark": remark,
        "source": source.name,
        "fps": FPS,
        "joints": JOINTS,
        "outputs": [output.name for output in outputs.outputs] if outputs else [],
        "limbs": [{"start": a, "end": b, "radii": radii, "tip": tip} for a, b, radii, tip in LIMBS],
        "heat": HEAT,
        "top": TOP,
        "worn": source.worn,
        **({"avatar": {"bones": VRM_BONES, "parents": PARENTS, "unit": UNIT}} if avatar else {}),
    }


def run_loop(
    stream: Stream,
    source: TrackerSource,
    publish: Publish,
    stopped: threading.Event,
    outputs: Outputs | None = None,
    fitting: Fitting | None = None,
    avatar: bool = False,
    report: Callable[[str], None] = lambda line: None,
) -> None:
    """Feed samples to the stream, and its frames to the outputs and to open pages, until `stopped` is set.

    Args:
        stream: the stream of poses; its network is `stream.network`.
        source: gives the samples.
        publish: gets the messages (`frame_message`); for a malformed sample, the counts alone.
        stopped: ends the loop.
        outputs: get the frames first.
        fitting: fits the stream to its wearer between the samples.
        avatar: whether messages include the avatar's pose (`avatar_message`).
        report: gets a line if samples are odd (`OddSamples`), and for the first malformed sample.
    """
    stream.odd = OddSamples(report)
    number, counts = 0, {"dropped": 0, "malformed": 0}
    while not stopped.is_set():
        try:
            sample = source.read()
            if fitting:
                fitting.step(sample and sample.trackers)
            if sample is None:
                continue
            counts["dropped"] += sample.dropped
            frame = stream.step_body(*sample.trackers, time=sample.time)
        except InputError as error:
            counts["malformed"] += 1
            if counts["malformed"] == 1:
                report(f"a sample is rejected: {error}")
            publish(dict(counts))
            continue
        if not frame.fresh:
            continue
        if outputs:
            outputs.take(frame)
        whole = 1000 * (time.perf_counter() - sample.arrived)
        message = {"number": number, **frame_message(stream, frame, source.truth(frame.time))}
        message |= {"whole": round(whole, 3), **counts}
        publish(message | (avatar_message(frame) if avatar else {}))
        number += 1


def frame_message(stream: Stream, frame: BodyFrame, truth: np.ndarray | None) -> dict[str, Any]:
    """Return the message about a stream's newest frame, without its number and the loop's counts.

    It has the frame's time (s), the held trackers, whether the samples' times jump (`OddSamples`), the
    milliseconds that the exported step took (`ms`), and the joints' positions, predicted and true (66 whole
    millimetres each, in openxr's axes). The loop adds the milliseconds from the sample's arrival until all
    outputs had the pose (`whole`).
    """
    return {
        "time": round(frame.time, 4),
        "held": frame.held,
        "jumping": stream.odd.jumping,
        "ms": round(1000 * stream.step_seconds, 3),
        "positions": to_millimetres(raise_by(frame.positions, stream.wearer.floor)),
        "truth": to_millimetres(truth),
    }


def to_millimetres(joints: np.ndarray | None) -> list[int] | None:
    """Return joints (22, 3), metres, AMASS' world, as a flat list of millimetres in the page's axes."""
    if joints is None:
        return None
    positions = PAGE_SPACE.positions_out(np.asarray(joints, np.float64))
    return (1000 * positions).round().astype(int).ravel().tolist()


def avatar_message(frame: BodyFrame) -> dict[str, Any]:
    """Return the part of a message for an avatar: the joints' rotations, and the wearer's hips, metres.

    The rotations are 22 quaternions xyzw as 88 whole numbers, relative to VRM's T-pose, which is SMPL's: Y
    up, facing +Z. The root's is in the page's axes. The height of the hips in the rest pose, metres, gives
    the avatar its size; the wearer may change it on the page at any time.
    """
    local = frame.local.copy()
    local[0] = PAGE_SPACE.world.T @ local[0]
    turns = (UNIT * matrix_to_quaternion(local)).round().astype(int).ravel().tolist()
    hips = float(frame.rest[ROOT, 1] - frame.rest[:, 1].min())  # above the lowest joint
    return {"turns": turns, "hips": round(hips, 4)}


class Order(NamedTuple):
    """An order from the page.

    Attributes:
        action: one of ACTIONS.
        value: metres for height and floor; seconds of the countdown for calibrate and touch_floor.
    """

    action: str
    value: float | None


def read_order(fields: object) -> Order:
    """Read an order: {"action": ..., "value": ...}. Raises InputError for any other."""
    if not isinstance(fields, dict) or fields.get("action") not in ACTIONS:
        raise InputError(f"action: must be one of {', '.join(ACTIONS)}")
    value = fields.get("value")
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if value is not None and not (number and math.isfinite(value)):
        raise InputError("value: must be a finite number")
    return Order(fields["action"], value)


class Fitting:
    """Fits a stream to its wearer by orders: body height, floor, calibration in a T-pose.

    Args:
        stream: the stream.
        space: the stream's frame of reference.
        path: the file to which each change is saved; None to save nothing.
        publish_state: gets "wearer" and the state whenever the state changes.
        clock: returns the time, seconds.
    """

    def __init__(
        self,
        stream: Stream,
        space: SpaceName,
        path: Path | None,
        publish_state: PublishState,
        clock: Callable[[], float] = time.monotonic,
    ):
        self.stream, self.space, self.path = stream, space, path
        self.publish_state, self.clock = publish_state, clock
        self.orders: queue.SimpleQueue[Order] = queue.SimpleQueue()
        self.waiting: Order | None = None
        self.due = 0.0
        self.height: float | None = None if stream.wearer.scale == 1 else stream.wearer.height
        self._publish_state("")

    def ask(self, fields: object) -> None:
        """Take an order, from any thread. Raises InputError if it is not a valid order."""
        self.orders.put(read_order(fields))

    def step(self, trackers: QuaternionPoses | None) -> None:
        """Carry out the orders that are due: new ones at once, and a waiting one after its countdown.

        Args:
            trackers: the devices' current poses; None if no sample came.
        """
        while not self.orders.empty():
            order = self.orders.get()
            if order.action in ("calibrate", "touch_floor"):
                seconds = COUNTDOWN if order.value is None else min(max(order.value, 0.0), LONGEST)
                self.waiting, self.due = order, self.clock() + seconds
                self._publish_state("")
            else:
                self.waiting = None
                self._carry_out(order, None)
        if self.waiting and trackers and self.clock() >= self.due:
            order, self.waiting = self.waiting, None
            self._carry_out(order, trackers)

    def _carry_out(self, order: Order, trackers: QuaternionPoses | None) -> None:
        """Carry out an order, save what it changed, and publish the result."""
        try:
            line = self._change(order, trackers)
            if self.path is not None and order.action != "cancel":
                stream = self.stream
                made = Calibration(self.space, stream.offsets, self.height, stream.wearer.floor)
                save_calibration(self.path, made, stream.network.body)
        except InputError as error:
            self._publish_state(str(error), failed=True)
        else:
            self._publish_state(line)

    def _change(self, order: Order, trackers: QuaternionPoses | None) -> str:
        """Change the stream by an order, and return a line about the result."""
        stream, value = self.stream, order.value
        if order.action == "calibrate" and trackers:
            offsets = stream.calibrate(*trackers)
            farthest = 100 * offsets.distances.max()
            line = f"Calibrated; the devices are up to {farthest:.0f} cm from the joints."
            return f"{line} But {offsets.doubt}" if offsets.doubt else line
        if order.action == "height":
            calibrated = stream.offsets is not None
            stream.fit(value, stream.wearer.floor)
            self.height = value
            return f"Calibrate again: {FORGOTTEN}." if calibrated and stream.offsets is None else ""
        if order.action == "touch_floor" and trackers:
            hands = [tracker[0] for tracker in trackers[1:] if tracker is not None]
            if not hands:
                raise InputError("floor: no hand is tracked; touch the floor with one")
            value = round(min(float(stream.space.positions_in(hand)[2]) for hand in hands), 4)
        if order.action in ("floor", "touch_floor"):
            stream.fit(self.height, value or 0.0)
            return f"The floor is at {100 * (value or 0.0):.0f} cm."
        if order.action == "forget":
            stream.offsets = None
            stream.reset()
            return "The calibration is forgotten."
        return ""  # cancel

    def _publish_state(self, line: str, failed: bool = False) -> None:
        stream, waiting = self.stream, self.waiting
        remaining = round(max(self.due - self.clock(), 0.0), 2)
        state = {
            "height": round(100 * stream.wearer.height, 1),
            "floor": round(100 * stream.wearer.floor, 1),
            "calibrated": stream.offsets is not None,
            "waiting": waiting and {"action": waiting.action, "seconds": remaining},
            "line": line,
            "failed": failed,
            "file": self.path and self.path.name,
        }
        self.publish_state("wearer", state)
