"""Orders of the page: what they do to the stream, when, and what is told and saved."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from memmlp.common.errors import InputError
from memmlp.live.calibration_file import read_calibration
from memmlp.live.rotations import matrix_to_quaternion
from memmlp.live.session.wearer_fitting import COUNTDOWN, Fitting, read_order
from memmlp.live.stream import Stream
from memmlp.live.tracker_resampling import t_pose

pytestmark = pytest.mark.slow


class Wearing:
    """A stream that is fitted by a clock of the test's own."""

    def __init__(self, network: Path, folder: Path):
        self.stream, self.path = Stream(network), folder / "me.json"
        self.told: list[Mapping[str, Any]] = []
        self.now = 10.0
        self.fitting = Fitting(self.stream, "amass", self.path, self.tell, lambda: self.now)

    def tell(self, name: str, state: Mapping[str, Any]) -> None:
        assert name == "wearer"
        self.told.append(state)

    def order(self, action: str, value: float | None = None) -> None:
        self.fitting.ask({"action": action, "value": value})

    def pose(self, shift: float = 0.0, lower: float = 0.0):
        """Devices of a person in T-pose, 5 cm before the joints; the left hand shifted, both lowered."""
        pose = t_pose(self.stream.network.body, np.array([0.0, 0.0, 1.57]), 0.0)
        positions = pose.positions + np.array([0, -0.05, 0])
        positions[1, 1] += shift
        positions[1:, 2] -= lower
        return tuple(zip(positions, matrix_to_quaternion(pose.rotations), strict=True))


@pytest.fixture
def worn(network: Path, tmp_path: Path) -> Wearing:
    return Wearing(network, tmp_path)


def test_a_calibration_waits_for_its_countdown(worn: Wearing):
    worn.order("calibrate")
    worn.fitting.step(worn.pose(0.2))
    assert worn.told[-1]["waiting"] == {"action": "calibrate", "seconds": COUNTDOWN}
    worn.now += COUNTDOWN - 0.1
    worn.fitting.step(worn.pose(0.2))
    assert worn.stream.offsets is None
    worn.now += 0.2
    worn.fitting.step(None)  # no sample came
    assert worn.stream.offsets is None
    worn.fitting.step(worn.pose())
    assert worn.stream.offsets is not None
    state = worn.told[-1]
    assert (state["waiting"], state["calibrated"], state["failed"], state["file"]) == (
        None,
        True,
        False,
        "me.json",
    )
    assert "0 cm from the joints" in state["said"]
    saved = read_calibration(worn.path, "amass", worn.stream.network.body).offsets
    np.testing.assert_allclose(saved.positions, worn.stream.offsets.positions)


def test_who_stands_otherwise_is_told_and_nothing_changes(worn: Wearing):
    worn.order("calibrate", 0)
    worn.fitting.step(worn.pose())
    before = worn.stream.offsets
    worn.order("calibrate", 0)
    worn.fitting.step(worn.pose(shift=0.9))
    assert worn.stream.offsets is before
    assert worn.told[-1]["failed"]
    assert "head is 31 cm from where a T-pose has it" in worn.told[-1]["said"]
    head, _, right = worn.pose()
    worn.order("calibrate", 0)
    worn.fitting.step((head, None, right))
    assert "no pose of left" in worn.told[-1]["said"]
    assert worn.stream.offsets is before


def test_exchanged_controllers_are_told_and_nothing_changes(worn: Wearing):
    head, left, right = worn.pose()
    worn.order("calibrate", 0)
    worn.fitting.step((head, right, left))
    assert worn.stream.offsets is None
    assert worn.told[-1]["failed"]
    assert "left and right look exchanged" in worn.told[-1]["said"]


def test_quaternions_in_another_order_are_told(worn: Wearing):
    worn.stream.odd.tell = (told := []).append
    worn.order("calibrate", 0)
    worn.fitting.step(tuple((place, np.roll(turn, 1)) for place, turn in worn.pose()))
    assert worn.told[-1]["calibrated"]
    assert "But the head's device is 90 degrees from upright; are quaternions xyzw" in worn.told[-1]["said"]
    assert told == [
        "calibrate: the head's device is 90 degrees from upright; are quaternions xyzw, and is `space` right?"
    ]


def test_height_and_floor(worn: Wearing):
    worn.order("height", 1.86)
    worn.order("touch_floor", 0)
    worn.fitting.step(worn.pose(lower=1.35))
    state = worn.told[-1]
    assert (state["height"], state["floor"]) == (186, pytest.approx(6, abs=0.2))
    assert worn.stream.wearer.floor == pytest.approx(0.06, abs=0.002)
    worn.order("floor", 0.0)
    worn.order("height", None)
    worn.fitting.step(None)
    assert (worn.stream.wearer.scale, worn.stream.wearer.floor) == (1, 0)
    saved = read_calibration(worn.path, "amass", worn.stream.network.body)
    assert (saved.height, saved.floor) == (None, 0)


def test_another_height_forgets_the_calibration(worn: Wearing):
    """Its offsets are of the height before: seven centimetres at the hands, which a file would keep."""
    worn.order("calibrate", 0)
    worn.fitting.step(worn.pose())
    worn.order("height", round(worn.stream.wearer.height, 3))  # the same, as the page shows it
    worn.fitting.step(None)
    assert worn.stream.offsets is not None
    worn.order("height", 1.90)
    worn.fitting.step(None)
    assert worn.stream.offsets is None
    state = worn.told[-1]
    assert (state["calibrated"], state["height"], state["failed"]) == (False, 190, False)
    assert state["said"].startswith("Calibrate again: the calibration was of another height")
    saved = read_calibration(worn.path, "amass", worn.stream.network.body)
    assert (saved.offsets, saved.height) == (None, 1.90)


def test_a_height_of_nobody_forgets_nothing(worn: Wearing):
    worn.order("calibrate", 0)
    worn.fitting.step(worn.pose())
    worn.order("height", 18.0)
    worn.fitting.step(None)
    assert worn.stream.offsets is not None


def test_a_hand_that_was_not_seen_touches_no_floor(worn: Wearing):
    head, _, _ = worn.pose()
    worn.order("touch_floor", 0)
    worn.fitting.step((head, None, None))
    assert worn.told[-1]["failed"]
    assert not worn.path.exists()


def test_forgotten_and_cancelled(worn: Wearing):
    worn.order("calibrate", 0)
    worn.fitting.step(worn.pose())
    worn.order("forget")
    worn.order("calibrate")
    worn.order("cancel")
    worn.now += 100
    worn.fitting.step(worn.pose())
    assert worn.stream.offsets is None
    assert read_calibration(worn.path, "amass", worn.stream.network.body).offsets is None
    assert (worn.told[-1]["waiting"], worn.told[-1]["calibrated"]) == (None, False)


def test_a_height_of_nobody_is_told(worn: Wearing):
    worn.order("height", 18.0)
    worn.fitting.step(None)
    assert worn.told[-1]["said"].startswith("height=18.0: allowed are")
    assert worn.stream.wearer.scale == 1


@pytest.mark.parametrize(
    "fields", [None, [], {}, {"action": "stop"}, {"action": "height", "value": "tall"},
               {"action": "height", "value": True}, {"action": "height", "value": float("nan")}]
)  # fmt: skip
def test_what_is_no_order_is_refused(fields):
    with pytest.raises(InputError, match=r"action: |value: "):
        read_order(fields)
