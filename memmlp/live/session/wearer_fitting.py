"""Fits a running stream to its wearer by orders from the page: body height, floor, calibration in a T-pose.

Orders arrive in the server's threads and are carried out between two samples. The wearer has to walk away
from the keyboard before a calibration, so it waits for a countdown.
"""

from __future__ import annotations

import math
import queue
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from memmlp.common.errors import InputError
from memmlp.live.calibration_file import Calibration, save_calibration
from memmlp.live.session.packets import QuaternionPoses
from memmlp.live.spaces import SpaceName
from memmlp.live.stream import FORGOTTEN, Stream

COUNTDOWN = 5.0  # seconds
LONGEST = 60.0  # seconds of a countdown
ACTIONS = ("calibrate", "touch_floor", "height", "floor", "forget", "cancel")

Tell = Callable[[str, Mapping[str, Any]], None]


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
        raise InputError(f"action: allowed are {', '.join(ACTIONS)}")
    value = fields.get("value")
    if value is not None and (isinstance(value, bool) or not isinstance(value, int | float)):
        raise InputError("value: no number")
    if value is not None and not math.isfinite(value):
        raise InputError("value: no finite number")
    return Order(fields["action"], value)


class Fitting:
    """Fits a stream to its wearer.

    Args:
        stream: the stream.
        space: the stream's frame of reference.
        path: the file to which each change is saved; None to save nothing.
        tell: gets "wearer" and the state whenever the state changes.
        clock: returns the time, seconds.
    """

    def __init__(
        self,
        stream: Stream,
        space: SpaceName,
        path: Path | None,
        tell: Tell,
        clock: Callable[[], float] = time.monotonic,
    ):
        self.stream, self.space, self.path = stream, space, path
        self.tell, self.clock = tell, clock
        self.orders: queue.SimpleQueue[Order] = queue.SimpleQueue()
        self.waiting: Order | None = None
        self.due = 0.0
        self.own_height: float | None = None if stream.wearer.scale == 1 else stream.wearer.height
        self.actions: dict[str, Callable[[Any], str]] = {
            "calibrate": self._calibrate,
            "touch_floor": self._touch_floor,
            "height": self._height,
            "floor": self._floor,
            "forget": self._forget,
            "cancel": self._cancel,
        }
        self._say("")

    def ask(self, fields: object) -> None:
        """Take an order, from any thread. Raises InputError if it is no valid order."""
        self.orders.put(read_order(fields))

    def step(self, trackers: QuaternionPoses | None) -> None:
        """Carry out the orders that are due: new ones at once, and a waiting one after its countdown.

        Args:
            trackers: the devices' present poses; None if no sample came.
        """
        while not self.orders.empty():
            self._begin(self.orders.get())
        if self.waiting and trackers and self.clock() >= self.due:
            order, self.waiting = self.waiting, None
            self._carry_out(order, trackers)

    def _begin(self, order: Order) -> None:
        """Carry out an order, or start its countdown."""
        if order.action in ("calibrate", "touch_floor"):
            seconds = COUNTDOWN if order.value is None else min(max(order.value, 0.0), LONGEST)
            self.waiting, self.due = order, self.clock() + seconds
            self._say("")
        else:
            self.waiting = None
            self._carry_out(order, None)

    def _carry_out(self, order: Order, trackers: QuaternionPoses | None) -> None:
        """Carry out an order, save what it changed, and report the result."""
        try:
            # Actions after a countdown need the trackers; the others need the order's value.
            said = self.actions[order.action](order.value if trackers is None else trackers)
            if order.action != "cancel":
                self._save()
        except InputError as error:
            self._say(str(error), failed=True)
        else:
            self._say(said)

    def _calibrate(self, trackers: QuaternionPoses) -> str:
        """Learn the offsets of the devices."""
        offsets = self.stream.calibrate(*trackers)
        said = f"Calibrated; the devices are up to {100 * offsets.distances.max():.0f} cm from the joints."
        return f"{said} But {offsets.doubt}" if offsets.doubt else said

    def _touch_floor(self, trackers: QuaternionPoses) -> str:
        """Set the floor's height to that of the lower hand."""
        hands = [tracker[0] for tracker in trackers[1:] if tracker is not None]
        if not hands:
            raise InputError("floor: no hand was seen; touch the floor with one")
        floor = min(float(self.stream.space.positions_in(hand)[2]) for hand in hands)
        return self._floor(round(floor, 4))

    def _height(self, value: float | None) -> str:
        """Set the wearer's body height, metres; None for the network's. A calibration is of one height."""
        forgotten = self.stream.refit(value, self.stream.wearer.floor)
        self.own_height = value
        return f"Calibrate again: {FORGOTTEN}." if forgotten else ""

    def _floor(self, value: float | None) -> str:
        """Set the height of the floor, metres."""
        self.stream.fit(self.own_height, value or 0.0)
        return f"The floor is at {100 * (value or 0.0):.0f} cm."

    def _forget(self, _: float | None) -> str:
        """Forget the calibration: devices count as joints again."""
        self.stream.offsets = None
        self.stream.reset()
        return "The calibration is forgotten."

    def _cancel(self, _: float | None) -> str:
        return ""

    def _save(self) -> None:
        if self.path is not None:
            stream = self.stream
            made = Calibration(self.space, stream.offsets, self.own_height, stream.wearer.floor)
            save_calibration(self.path, made, stream.network.body)

    def _say(self, said: str, failed: bool = False) -> None:
        stream, waiting = self.stream, self.waiting
        left = None if waiting is None else round(max(self.due - self.clock(), 0.0), 2)
        state = {
            "height": round(100 * stream.wearer.height, 1),
            "floor": round(100 * stream.wearer.floor, 1),
            "calibrated": stream.offsets is not None,
            "waiting": waiting and {"action": waiting.action, "seconds": left},
            "said": said,
            "failed": failed,
            "file": self.path and self.path.name,
        }
        self.tell("wearer", state)
