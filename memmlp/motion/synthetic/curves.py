"""Smooth functions of time, on arrays of seconds (N,), of which the motions are made."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import convolve1d, minimum_filter1d

Array = np.ndarray


def ease(t: Array, start: float, end: float) -> Array:
    """Return (N,): 0 before `start`, 1 after `end`, minimum jerk between."""
    s = np.clip((t - start) / (end - start), 0.0, 1.0)
    return s * s * s * (10.0 - s * (15.0 - 6.0 * s))


def pulse(t: Array, start: float, top: float, leave: float, end: float) -> Array:
    """Return (N,): 0, rising from `start` to 1 at `top`, falling from `leave` to 0 at `end`."""
    return ease(t, start, top) - ease(t, leave, end)


def glide(t: Array, start: float, end: float, ramp: float = 0.3) -> Array:
    """Return (N,): as `ease`, but at an even speed between two ramps that take `ramp` of the time each."""

    def ramped(x: Array) -> Array:  # the integral of an ease from 0 to 1
        c = np.clip(x, 0.0, 1.0)
        return c**4 * (2.5 - c * (3.0 - c)) + np.maximum(x - 1.0, 0.0)

    s = np.clip((t - start) / (end - start), 0.0, 1.0)
    return (ramped(s / ramp) - ramped((s - 1.0) / ramp + 1.0)) * ramp / (1.0 - ramp)


def arc(t: Array, start: float, end: float) -> Array:
    """Return (N,): 0 outside [start, end], 1 in the middle, velocity and acceleration 0 at both ends."""
    s = glide(t, start, end)
    return 4.0 * s * (1.0 - s)


def wander(
    rng: np.random.Generator, t: Array, shape: tuple[int, ...] = (), low: float = 0.1, high: float = 1.0
) -> Array:
    """Return natural variation (N, *shape) of RMS 1: independent sums of six sines of `low` to `high` Hz."""
    size = (6, *shape)
    frequency = np.exp(rng.uniform(np.log(low), np.log(high), size))
    amplitude = rng.uniform(0.5, 1.0, size) / np.sqrt(frequency)
    amplitude *= np.sqrt(2.0 / (amplitude**2).sum(0))
    start = rng.uniform(0.0, 2 * np.pi, size)
    time = t.reshape(-1, *([1] * len(shape)))
    result = np.zeros((len(t), *shape))
    for wave in range(6):
        result += amplitude[wave] * np.sin(2 * np.pi * frequency[wave] * time + start[wave])
    return result


def smooth(x: Array, frames: int) -> Array:
    """Return the moving average (N, ...) under a bell of 2 * `frames` + 1 frames."""
    kernel = np.hanning(2 * frames + 3)[1:-1] ** 2
    return convolve1d(x, kernel / kernel.sum(), axis=0, mode="nearest")


def smooth_below(x: Array, frames: int) -> Array:
    """Return a smooth curve (N,) that is nowhere above `x`: the running minimum's average under the bell."""
    return smooth(minimum_filter1d(x, 2 * frames + 1, mode="nearest"), frames)


def soft_minimum(a: Array, b: Array, width: float) -> Array:
    """Return a smooth curve below both `a` and `b`.

    It is within `width` / 2 of their minimum, and nearer where they differ more.
    """
    return 0.5 * (a + b - np.sqrt((a - b) ** 2 + width**2))
