"""Feet: where they stand, and how they step from one position to the next."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from memmlp.motion.synthetic.curves import Array, arc, glide, pulse


@dataclass(frozen=True)
class FootStep:
    """One step of one foot; seconds, metres, radians.

    Attributes:
        foot: 0 left, 1 right.
        off: when the toes leave the floor.
        on: when the heel touches the floor again.
        to: position (2,) on the floor below the ankle, world.
        yaw: direction of the foot after the step, world.
        lift: how high the foot is lifted on the way.
        heel: angle by which the heel is up when the toes leave.
        toe: angle by which the toes are up when the heel arrives.
        push: how long before `off` the heel rises.
        roll: how long after `on` the toes come down.
    """

    foot: int
    off: float
    on: float
    to: Array
    yaw: float
    lift: float = 0.05
    heel: float = 0.4
    toe: float = 0.1
    push: float = 0.15
    roll: float = 0.1


@dataclass
class Feet:
    """Both feet over N frames, left and right.

    Attributes:
        ground: position (N, 2, 3) of the flat foot, below the ankle, metres, world; z is 0 on the floor.
        yaw: direction (N, 2), radians, world.
        heel: angle (N, 2), radians, at least 0, by which the foot is turned about its ball.
        toe: angle (N, 2), radians, at least 0, by which it is turned about its heel.
        planted: whether (N, 2) ball or heel are on the floor.
    """

    ground: Array
    yaw: Array
    heel: Array
    toe: Array
    planted: Array


def tread(t: Array, places: Array, yaws: Array, steps: Iterable[FootStep]) -> Feet:
    """Return feet that make steps in order of time.

    Args:
        t: times (N,), seconds.
        places: where (2, 2) the feet start, metres, world.
        yaws: their directions (2,) there, radians, world.
        steps: the steps, in order of time.
    """
    n = len(t)
    ground = np.zeros((n, 2, 3))
    ground[:, :, :2] = places
    feet = Feet(ground, np.tile(yaws, (n, 1)), np.zeros((n, 2)), np.zeros((n, 2)), np.ones((n, 2), bool))
    place, yaw = np.array(places, float), np.array(yaws, float)
    for step in steps:
        foot, off, on = step.foot, step.off, step.on
        part = glide(t, off, on)
        ground[:, foot, :2] += part[:, None] * (step.to - place[foot])
        ground[:, foot, 2] += step.lift * arc(t, off, on)
        feet.yaw[:, foot] += part * (step.yaw - yaw[foot])
        feet.heel[:, foot] += step.heel * pulse(t, off - step.push, off, off, off + 0.7 * (on - off))
        feet.toe[:, foot] += step.toe * pulse(t, on - 0.5 * (on - off), on, on, on + step.roll)
        feet.planted[:, foot] &= (t <= off) | (t >= on)
        place[foot], yaw[foot] = step.to, step.yaw
    return feet
