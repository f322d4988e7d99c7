"""Samples that are hardly metres or seconds: they are told once of each kind, and what people do is not."""

import math
import warnings
from collections.abc import Iterable

import numpy as np
import pytest

import memmlp
from memmlp.common.errors import InputError
from memmlp.live.rotations import matrix_to_quaternion
from memmlp.live.tracker_input import JUMPS, STILL, OddSamples, TrackerReader, check_time
from memmlp.live.tracker_resampling import UPRIGHT

ONE = ([0, 0, 1.6], np.eye(3))
STANDING = np.array([[0, 0, 1.57], [0.7, 0, 1.4], [-0.7, 0, 1.4]])
ALL, NO_HANDS = (False, False, False), (False, True, True)


def warnings_for(
    times: Iterable[float | None], positions: np.ndarray = STANDING, lost: tuple[bool, ...] = ALL
) -> list[str]:
    told: list[str] = []
    odd = OddSamples(told.append)
    for time in times:
        odd.take(time, positions, lost)
    return told


def test_usual_times_cause_no_warning():
    for name, times in {
        "pauses": (0.0, 1.0, 2.0, 3.0, 4.0, 4.1, 5.1, 3.1, 3.2), "steady": [n / 60 for n in range(200)],
        "epoch": [1.7e9 + n / 60 for n in range(200)],
        "single precision, fine so early": [float(np.float32(1000 + n / 60)) for n in range(200)],
        "each twice": [time for n in range(100) for time in (n / 60, n / 60)],
        "still for a while": [7.0] * (STILL - 1), "beyond": [1e10],
    }.items():  # fmt: skip
        assert warnings_for(times) == [], name


def test_times_of_no_clock_are_reported_once():
    for start, words in ((1e5, "times in single precision"), (1.7e9, "does not stand still")):
        said = warnings_for(float(np.float32(start + n / 60)) for n in range(300))
        assert (sum(words in line for line in said), len(said)) == (1, len(set(said)))
    assert len(warnings_for([5.0] * 300)) == 1


def test_units_other_than_metres_are_reported():
    for unit in (100, 1000, 39.4):  # centimetres, millimetres, inches
        far, high = warnings_for([None] * STILL, unit * STANDING)
        assert far.startswith(f"{JUMPS} consecutive samples have a hand over 5 m from the head")
        assert "have the head over 3 m above the floor" in high
        assert warnings_for([None] * (JUMPS - 1), unit * STANDING) == []
        assert warnings_for([None] * STILL, unit * STANDING, NO_HANDS) == [high]
        assert warnings_for([None] * STILL, unit * STANDING, (True, False, False)) == []


def test_usual_places_cause_no_warning():
    for moved in ([300.0, -200.0, 0], [0, 0, 1.2], [0, 0, -1.4]):  # far from the origin, jumping, lying
        assert warnings_for([None] * STILL, STANDING + moved) == []
    lost = np.array([[40.0, 0, 1.57], [0, 0, 0], [0, 0, 0]])
    assert warnings_for([None] * STILL, lost, NO_HANDS) == []


@pytest.mark.slow
def test_a_stream_warns_at_the_line_of_its_caller(step_files):
    for unit, second, kinds in (
        (1, 1, []),
        (100, 1, ["a hand over 5 m", "the head over 3 m"]),
        (1, 1000, ["each restarts the network"]),
    ):
        stream = memmlp.Stream(step_files("no_memory"))
        turn = matrix_to_quaternion(UPRIGHT[None])[0]
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            for index in range(60):
                stream.step(*((place, turn) for place in unit * STANDING), time=second * index / 60)
        assert [warning.category for warning in caught] == [memmlp.SampleWarning] * len(kinds)
        for warning, words in zip(caught, kinds, strict=True):
            assert words in str(warning.message)
            assert warning.filename == __file__


@pytest.mark.parametrize(("tracker", "words"), [
    (([0, 0], np.eye(3)), "position has shape .2,."),
    (([0, 0, 0], np.eye(4)), "rotation has shape .4, 4."),
    (([0, 0, 1], [0, 0, 0, 2]), "quaternion has norm 2;"),
    (([0, 0, 1], 1.1 * np.eye(3)), ".*not orthonormal"), (([0, 0, 1], np.diag([1, 1, -1])), ".*mirrors"),
    ("no", "expected .position, rotation."), (([0, 0, 0],), "expected .position, rotation."),
])  # fmt: skip
def test_bad_trackers_are_rejected(tracker, words: str):
    with pytest.raises(InputError, match=f"left: {words}"):
        TrackerReader(60).read((ONE, tracker, ONE))


def test_bad_times_are_rejected():
    check_time(None), check_time(5), check_time(np.float32(1.5))
    for time in (float("nan"), 1e20, -math.inf, "1.0", [1]):
        with pytest.raises(InputError, match="time="):
            check_time(time)


NAN, IDENTITY = math.nan, [0, 0, 0, 1]
POSES = [
    (True, None), (True, [None, IDENTITY]), (True, [[0.7, 1.4, 0], None]), (True, [[NAN] * 3, [NAN] * 4]),
    (True, [[None] * 3, [None] * 4]), (True, [[0.7, None, 0], IDENTITY]),
    (True, [[0, 0, 0], [0, 0, 0, 0]]), (True, [[0.7, 1.4, 0], [0, 0, 0, 0]]),
    (True, [[0, 0, 0], IDENTITY]), (True, [[2e6, 0, 0], IDENTITY]),
    (True, [[0.7, 1.4, 0], [0, NAN, 0, 1]]), (True, [[0.7, math.inf, 0], IDENTITY]),
    (True, [[0.7, 1.4, 0], [0, 0, 0, 1e-3]]), (False, [[0.7, 1.4, 0], IDENTITY]),
    (False, [[0, 1e-4, 0], [0, 1, 0, 0]]), (False, [[0, 0, 1.4], [0.5, 0.5, 0.5, -0.5]]),
]  # fmt: skip
"""Whether a pose is lost, and the pose: position and quaternion."""


@pytest.mark.parametrize(("is_lost", "pose"), POSES)
def test_what_programs_send_for_a_lost_tracker_is_lost(is_lost: bool, pose):
    for place in range(3):
        trackers = [ONE, ONE, ONE]
        trackers[place] = pose
        positions, _, lost = TrackerReader(60).read(trackers)
        assert lost == tuple(is_lost and index == place for index in range(3))
        assert np.isfinite(positions).all()
    assert TrackerReader(60).read((ONE, ([0, 0, 1.4], np.zeros((3, 3))), ONE))[2] == (False, True, False)


def test_a_tracker_that_repeats_its_pose_while_another_moves_is_lost():
    """Not when all are still, and not where a slow tracker repeats some samples."""

    def frozen(moves: Iterable[tuple[bool, bool, bool]], hz: float = 60) -> list[tuple[bool, ...]]:
        reader, steps, found = TrackerReader(60), np.zeros(3), []
        for index, move in enumerate(moves):
            steps = steps + move
            trackers = [([0.1 * step, k, 1], np.eye(3)) for k, step in enumerate(steps.tolist())]
            found.append(reader.take(trackers, index / hz)[2])
        return found

    for place in range(3):
        others = tuple(index != place for index in range(3))
        found = frozen([(True, True, True)] * 9 + [others] * 60 + [(True, True, True)])
        assert found.index(tuple(not moves for moves in others)) in (39, 40)  # after half a second
        assert not any(found[-1])
    assert not any(map(any, frozen([(False, False, False)] * 200 + [(True, False, False)] * 20)))
    assert not any(map(any, frozen((True, index % 4 == 0, True) for index in range(200))))
    assert frozen([(True, False, True)] * 2, hz=1)[-1] == (False, False, False)  # a gap is not a second of it
