"""The loop of `memmlp live`: it reads samples, runs the stream, and sends poses to outputs and pages.

Between samples, it executes commands from the page, which adjust the stream to the user. Commands arrive in
the server's threads. A calibration starts after a countdown, so the user can leave the keyboard."""

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
from memmlp.live.stream import FORGOTTEN, BodyFrame, Stream, move_up
from memmlp.live.tracker_input import OddSamples
from memmlp.live.wearer import Calibration, save_calibration
from memmlp.motion.body import FPS, HEAT, JOINTS, LIMBS, PARENTS, ROOT
from memmlp.motion.formats.gltf import VRM_BONES

PAGE_SPACE = SPACES["openxr"]  # three.js uses the same axes
TOP = 20  # maximum of the page's colour scale, cm
UNIT = 10_000  # quaternions are multiplied by this number and sent as integers
COUNTDOWN = 5.0  # seconds
MAX_COUNTDOWN = 60.0  # maximum countdown, seconds
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
    """Return the first message to a page. `outputs` are the other receivers of poses; `remark` is a warning
    about the network. If the page shows an avatar, the message contains its bones."""
    return {
        "network": network,
        "remark": remark,
        "source": source.name,
        "fps": FPS,
        "joints": JOINTS,
        "outputs": [output.name for output in outputs.outputs] if outputs else [],
        "limbs": [limb._asdict() for limb in LIMBS],
        "heat": HEAT,
        "top": TOP,
        "wearer": source.has_wearer,
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
    """Run the stream on samples, and send the frames to outputs, then to open pages, until `stopped` is set.
    `publish` gets the messages (`make_frame_message`, `make_avatar_message` with `avatar`), for a malformed
    sample only the counts. `fitting` executes the page's commands between samples. `report` gets a line about
    odd samples (`OddSamples`) and about the first malformed sample."""
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
                report(f"a sample was rejected ({error})")
            publish(dict(counts))
            continue
        if not frame.fresh:
            continue
        if outputs:
            outputs.take(frame)
        whole = 1000 * (time.perf_counter() - sample.arrived)
        message = {"number": number, **make_frame_message(stream, frame, source.get_true_joints(frame.time))}
        message |= {"whole": round(whole, 3), **counts}
        publish(message | (make_avatar_message(frame) if avatar else {}))
        number += 1


def make_frame_message(stream: Stream, frame: BodyFrame, truth: np.ndarray | None) -> dict[str, Any]:
    """Return the message about a stream's newest frame. `positions` and `truth` are predicted and true joints
    (22, 3), metres, AMASS' world. The loop adds the frame number, the counts, and `whole`: the milliseconds
    from the sample's arrival until all outputs have the pose."""
    return {
        "time": round(frame.time, 4),  # seconds
        "held": frame.held,  # the held trackers
        "jumping": stream.odd.jumping,  # whether the samples' times jump
        "ms": round(1000 * stream.step_seconds, 3),  # the computation time of the network, milliseconds
        "positions": convert_to_millimetres(move_up(frame.positions, stream.wearer.floor)),
        "truth": convert_to_millimetres(truth),
    }


def convert_to_millimetres(joints: np.ndarray | None) -> list[int] | None:
    """Convert joints (22, 3), metres, AMASS' world, to a flat list of millimetres in the page's axes."""
    if joints is None:
        return None
    positions = PAGE_SPACE.convert_positions_from_amass(np.asarray(joints, np.float64))
    return (1000 * positions).round().astype(int).ravel().tolist()


def make_avatar_message(frame: BodyFrame) -> dict[str, Any]:
    """Return the message fields for an avatar: `turns`, joint rotations as 22 quaternions xyzw, 88 integers,
    relative to VRM's T-pose, which is also SMPL's (Y up, facing +Z), with the root rotation in the page's
    axes; and `hips`, the height of the hips in the rest pose, metres, which determines the avatar's size."""
    local = frame.local.copy()
    local[0] = PAGE_SPACE.world.T @ local[0]
    turns = (UNIT * matrix_to_quaternion(local)).round().astype(int).ravel().tolist()
    hips = float(frame.rest[ROOT, 1] - frame.rest[:, 1].min())  # above the lowest joint
    return {"turns": turns, "hips": round(hips, 4)}


class PageCommand(NamedTuple):
    """A command from the page, one of ACTIONS. Its value is metres for height and floor, and the countdown in
    seconds for calibrate and touch_floor."""

    action: str
    value: float | None


def parse_page_command(fields: object) -> PageCommand:
    """Parse a command {"action": ..., "value": ...}. Raises InputError for invalid fields."""
    if not isinstance(fields, dict) or fields.get("action") not in ACTIONS:
        raise InputError(f"action: must be one of {', '.join(ACTIONS)}")
    value = fields.get("value")
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if value is not None and not (number and math.isfinite(value)):
        raise InputError("value: must be a finite number")
    return PageCommand(fields["action"], value)


class Fitting:
    """Executes commands that adjust a stream to its user: body height, floor, and calibration in a T-pose.
    After each change, the calibration file `path` (if any) is updated, and `publish_state` gets "wearer" and
    the new state. `clock` returns seconds."""

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
        self.commands: queue.SimpleQueue[PageCommand] = queue.SimpleQueue()
        self.waiting: PageCommand | None = None
        self.due = 0.0
        self.height: float | None = None if stream.wearer.scale == 1 else stream.wearer.height
        self._publish_state("")

    def submit_command(self, fields: object) -> None:
        """Queue a command, from any thread. Raises InputError for an invalid command."""
        self.commands.put(parse_page_command(fields))

    def step(self, trackers: QuaternionPoses | None) -> None:
        """Execute new commands, and the waiting command after its countdown, for the current poses of the
        devices, None without a sample."""
        while not self.commands.empty():
            command = self.commands.get()
            if command.action in ("calibrate", "touch_floor"):
                seconds = COUNTDOWN if command.value is None else min(max(command.value, 0.0), MAX_COUNTDOWN)
                self.waiting, self.due = command, self.clock() + seconds
                self._publish_state("")
            else:
                self.waiting = None
                self._execute(command, None)
        if self.waiting and trackers and self.clock() >= self.due:
            command, self.waiting = self.waiting, None
            self._execute(command, trackers)

    def _execute(self, command: PageCommand, trackers: QuaternionPoses | None) -> None:
        try:
            line = self._adjust_stream(command, trackers)
            if self.path is not None and command.action != "cancel":
                stream = self.stream
                calibration = Calibration(self.space, stream.offsets, self.height, stream.wearer.floor)
                save_calibration(self.path, calibration, stream.network.body)
        except InputError as error:
            self._publish_state(str(error), failed=True)
        else:
            self._publish_state(line)

    def _adjust_stream(self, command: PageCommand, trackers: QuaternionPoses | None) -> str:
        stream, value = self.stream, command.value
        if command.action == "calibrate" and trackers:
            offsets = stream.calibrate(*trackers)
            farthest = 100 * offsets.distances.max()
            line = f"Calibrated; the devices are up to {farthest:.0f} cm from the joints."
            return f"{line} Warning: {offsets.tilt_warning}" if offsets.tilt_warning else line
        if command.action == "height":
            calibrated = stream.offsets is not None
            stream.fit(value, stream.wearer.floor)
            self.height = value
            return f"Calibrate again: {FORGOTTEN}." if calibrated and stream.offsets is None else ""
        if command.action == "touch_floor" and trackers:
            positions, _, lost = stream.reader.read(trackers)
            if all(lost[1:]):
                raise InputError("floor: no hand is tracked; touch the floor with a tracked hand")
            heights = stream.space.convert_positions_to_amass(positions)[1:, 2]
            value = round(float(heights[~np.array(lost[1:])].min()), 4)
        if command.action in ("floor", "touch_floor"):
            stream.fit(self.height, value or 0.0)
            return f"The floor is at {100 * (value or 0.0):.0f} cm."
        if command.action == "forget":
            stream.offsets = None
            stream.reset()
            return "The calibration was removed."
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
