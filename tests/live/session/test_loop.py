"""The loop's messages, and orders of the page: their effect on the stream, when, and what is saved."""

import json
import math
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from memmlp.live.rotations import matrix_to_quaternion
from memmlp.live.session.loop import COUNTDOWN, Fitting, run_loop
from memmlp.live.session.sources import ClipSource, SourceSample, TrackedClip
from memmlp.live.stream import Stream
from memmlp.live.tracker_resampling import make_t_pose
from memmlp.live.wearer import read_calibration

pytestmark = pytest.mark.slow


class Wearing:
    """A stream that is fitted by a clock of the test's own."""

    def __init__(self, network: Path, folder: Path):
        self.stream, self.path = Stream(network), folder / "me.json"
        self.states: list[Mapping[str, Any]] = []
        self.now = 10.0
        self.stream.odd.report = lambda line: None  # the terminal
        self.fitting = Fitting(self.stream, "amass", self.path, self.publish, lambda: self.now)

    def publish(self, name: str, state: Mapping[str, Any]) -> None:
        assert name == "wearer"
        self.states.append(state)

    def order(self, action: str, value: float | None = None) -> None:
        self.fitting.submit_command({"action": action, "value": value})

    def pose(self, shift: float = 0.0, lower: float = 0.0):
        """Devices of a person in T-pose, 5 cm before the joints; the left hand shifted, both lowered."""
        pose = make_t_pose(self.stream.network.body, np.array([0.0, 0.0, 1.57]), 0.0)
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
    assert worn.states[-1]["waiting"] == {"action": "calibrate", "seconds": COUNTDOWN}
    for seconds, pose in ((COUNTDOWN - 0.1, worn.pose(0.2)), (0.2, None)):  # at its end no sample came
        worn.now += seconds
        worn.fitting.step(pose)
        assert worn.stream.offsets is None
    worn.fitting.step(worn.pose())
    state = worn.states[-1]
    assert (state["waiting"], state["file"]) == (None, "me.json")
    assert (state["calibrated"], state["failed"]) == (True, False)
    assert "0 cm from the joints" in state["line"]
    saved = read_calibration(worn.path, "amass", worn.stream.network.body).offsets
    np.testing.assert_allclose(saved.positions, worn.stream.offsets.positions)


def test_a_failed_order_is_reported_and_changes_nothing(worn: Wearing):
    head, left, right = worn.pose()
    worn.order("touch_floor", 0)
    worn.fitting.step((head, None, ([0, 0, 0], [0, 0, 0, 1])))  # no hand was seen
    assert worn.states[-1]["failed"]
    assert not worn.path.exists()
    worn.order("calibrate", 0)
    worn.fitting.step((head, left, right))
    before = worn.stream.offsets
    for pose, words in (
        (worn.pose(shift=0.9), "head is 31 cm"),
        ((head, None, right), "left"),
        ((head, ([math.nan] * 3, [0, 0, 0, 1]), right), "left"),
        ((head, right, left), "exchanged"),
    ):
        worn.order("calibrate", 0)
        worn.fitting.step(pose)
        assert worn.states[-1]["failed"]
        assert words in worn.states[-1]["line"]
        assert worn.stream.offsets is before is not None
    worn.order("height", 18.0)
    worn.fitting.step(None)
    assert worn.states[-1]["line"].startswith("height=18.0: ")
    assert worn.stream.wearer.scale == 1
    assert worn.stream.offsets is before


def test_height_and_floor(worn: Wearing):
    worn.order("height", 1.86)
    worn.order("touch_floor", 0)
    worn.fitting.step(worn.pose(lower=1.35))
    state = worn.states[-1]
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
    state = worn.states[-1]
    assert (state["calibrated"], state["height"], state["failed"]) == (False, 190, False)
    assert state["line"].startswith("Calibrate again")
    saved = read_calibration(worn.path, "amass", worn.stream.network.body)
    assert (saved.offsets, saved.height) == (None, 1.90)


class Instant(ClipSource):
    """A clip that is played without waiting, by a clock of its own; at its end it stops the loop."""

    def __init__(self, clip: TrackedClip, hz: float, stopped: threading.Event):
        self.now, self.stopped = 0.0, stopped
        super().__init__(clip, hz, lambda: self.now, self.pass_time)

    def pass_time(self, seconds: float) -> None:
        self.now += seconds

    def read(self) -> SourceSample | None:
        sample = super().read()
        if self.next == self.count:
            self.stopped.set()
        return sample


class Losing(Instant):
    """A clip in which the left hand is lost for a while, and a rotation is malformed once."""

    def read(self) -> SourceSample | None:
        sample = super().read()
        head, left, right = sample.trackers
        if 40 <= self.next < 50:
            left = None
        if self.next == 60:
            right = (right[0], np.array([0, 0, 0, 3.0]))
        return sample._replace(trackers=(head, left, right))


def played(network: Path, clip: TrackedClip, hz: float, kind: type[Instant] = Instant) -> tuple[list, list]:
    stopped, messages, said = threading.Event(), [], []
    run_loop(Stream(network), kind(clip, hz, stopped), messages.append, stopped, report=said.append)
    return messages, said


def test_frames_come_at_60_hz_with_truth_and_prediction_in_the_page_s_axes(network: Path, clip: TrackedClip):
    for hz in (60, 72, 90):
        messages, _ = played(network, clip, hz)
        assert [m["number"] for m in messages] == list(range(len(messages)))
        assert [m["time"] for m in messages] == pytest.approx(np.arange(len(messages)) / 60, abs=1e-4)
        assert len(messages) >= 119
    message, truth = messages[30], clip.interpolate_joints(0.5)
    expected = 1000 * truth[:, [0, 2, 1]].ravel() * np.tile([1, 1, -1], 22)
    assert message["truth"] == pytest.approx(expected, abs=1)
    joints = np.array(message["positions"]).reshape(22, 3)
    assert joints[15] == pytest.approx(np.array(message["truth"]).reshape(22, 3)[15], abs=1)
    assert message["whole"] > message["ms"] > 0
    json.dumps(message)


def test_held_trackers_and_malformed_samples_are_counted(network: Path, clip: TrackedClip):
    found, lines = played(network, clip, 60, Losing)
    messages = [message for message in found if "positions" in message]
    assert [message for message in found if "positions" not in message] == [{"dropped": 0, "malformed": 1}]
    assert "quaternion" in lines[0]
    assert [m["number"] for m in messages if m["held"]] == list(range(39, 49))
    assert messages[45]["held"] == ("left",)
    assert (messages[50]["malformed"], messages[-1]["malformed"]) == (0, 1)
