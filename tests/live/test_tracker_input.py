"""Samples that are hardly metres or seconds: they are told once of each kind, and what people do is not."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

import memmlp
from memmlp.common.errors import InputError
from memmlp.live.rotations import matrix_to_quaternion
from memmlp.live.tracker_input import JUMPS, STILL, OddSamples, check_time, read_trackers
from memmlp.live.tracker_resampling import UPRIGHT

ONE = ([0, 0, 1.6], np.eye(3))
STANDING = np.array([[0, 0, 1.57], [0.7, 0, 1.4], [-0.7, 0, 1.4]])
ALL, NO_HANDS = (False, False, False), (False, True, True)


def told_of(times: Iterable[float]) -> list[str]:
    """What is said of samples with these times."""
    told: list[str] = []
    odd = OddSamples(told.append)
    for time in times:
        odd.take(time, STANDING, (False, False, False))
    return told


@pytest.mark.parametrize(
    "times",
    [
        (0.0, 1.0, 2.0, 3.0, 4.0, 4.1, 5.1, 3.1, 3.2),
        [n / 60 for n in range(200)],
        [1.7e9 + n / 60 for n in range(200)],
        [float(np.float32(1000 + n / 60)) for n in range(200)],  # single precision, which is fine so early
        [time for n in range(100) for time in (n / 60, n / 60)],  # each twice
        [7.0] * (STILL - 1),
        [1e10],
    ],
    ids=["pauses", "steady", "epoch", "single", "twice", "a while", "beyond"],
)
def test_of_other_times_nothing_is_said(times: list[float]):
    assert told_of(times) == []


@pytest.mark.parametrize(
    ("times", "words"),
    [
        ([5.0] * 300, "does `time` stand still?"),
        ([float(np.float32(100_000 + n / 60)) for n in range(300)], "milliseconds so late"),
        ([float(np.float32(1.7e9 + n / 60)) for n in range(300)], "does `time` stand still?"),
    ],
    ids=["still", "single", "single epoch"],
)
def test_times_that_are_no_clock_s_are_told_once(times: list[float], words: str):
    said = told_of(times)
    assert sum(words in line for line in said) == 1
    assert len(said) == len(set(said))


def told_of_places(positions: np.ndarray, lost: tuple[bool, ...] = ALL, samples: int = STILL) -> list[str]:
    """What is said of samples without a time at these places."""
    told: list[str] = []
    odd = OddSamples(told.append)
    for _ in range(samples):
        odd.take(None, positions, lost)
    return told


@pytest.mark.parametrize("unit", [100, 1000, 39.4], ids=["centimetres", "millimetres", "inches"])
def test_other_units_than_metres_are_told(unit: float):
    far, high = told_of_places(unit * STANDING)
    assert far.startswith(f"{JUMPS} samples in a row have a hand over 5 m from the head")
    assert "have the head over 3 m above the floor" in high
    assert told_of_places(unit * STANDING, samples=JUMPS - 1) == []
    assert told_of_places(unit * STANDING, NO_HANDS) == [high]
    assert told_of_places(unit * STANDING, (True, False, False)) == []


def test_of_what_people_do_nothing_is_said():
    for moved in ([300.0, -200.0, 0], [0, 0, 1.2], [0, 0, -1.4]):  # far from the origin, jumping, lying
        assert told_of_places(STANDING + moved) == []
    lost = np.array([[40.0, 0, 1.57], [0, 0, 0], [0, 0, 0]])
    assert told_of_places(lost, NO_HANDS) == []


def warned(file: Path, unit: float, second: float) -> list[warnings.WarningMessage]:
    """What a stream warns of when it gets positions and times in such units, for a second."""
    stream = memmlp.Stream(file)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for index in range(60):
            head, left, right = ((place, matrix_to_quaternion(UPRIGHT[None])[0]) for place in unit * STANDING)
            stream.step(head, left, right, time=second * index / 60)
    return caught


@pytest.mark.slow
@pytest.mark.parametrize(
    ("unit", "second", "kinds"),
    [(1, 1, []), (100, 1, ["a hand over 5 m", "the head over 3 m"]), (1, 1000, ["restarts with each"])],
    ids=["metres", "centimetres", "milliseconds"],
)
def test_a_stream_warns_who_feeds_it(unit: float, second: float, kinds: list[str], step_files):
    caught = warned(step_files("no_memory"), unit, second)
    assert [warning.category for warning in caught] == [memmlp.SampleWarning] * len(kinds)
    for warning, words in zip(caught, kinds, strict=True):
        assert words in str(warning.message)
        assert warning.filename == __file__


# Malformed samples


@pytest.mark.parametrize(
    ("tracker", "words"),
    [
        (([0, 0], np.eye(3)), "left: a position of shape .2,."),
        (([0, 0, 0], np.eye(4)), "left: a rotation of shape .4, 4."),
        (([0, 0, 0], [0, 0, 0, 2]), "left: a quaternion of norm 2;"),
        (([0, 0, 0], 2 * np.eye(3)), "left: the matrix is not orthonormal"),
        (([0, 0, 0], np.diag([1, 1, -1])), "left: the matrix is a mirror image"),
        ("no", "left: expected .position, rotation."),
        (([0, 0, 0],), "left: expected .position, rotation."),
    ],
)
def test_bad_trackers_are_rejected(tracker, words):
    with pytest.raises(InputError, match=words):
        read_trackers((ONE, tracker, ONE))


@pytest.mark.parametrize("time", [float("nan"), 1e20, -math.inf, "1.0", [1]])
def test_bad_times_are_rejected(time):
    check_time(None), check_time(5), check_time(np.float32(1.5))
    with pytest.raises(InputError, match="time="):
        check_time(time)
