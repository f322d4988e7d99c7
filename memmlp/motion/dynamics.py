"""Finds wrong frame rates and exchanged legs from the dynamics of a clip.

A wrong rate changes the duration of steps, and the acceleration in flight, which is gravity. A factor of two
shows if the person walks, runs or jumps. A factor of 1.2, such as 25 Hz instead of 30 Hz, does not, and
neither does a person who stands or dances on the spot.

If a file's left leg is on the right hip, each foot slides on the floor whenever the pelvis turns. The feet
would stand still if the legs were exchanged. This does not show in a person who never turns the pelvis.

The limits are beyond all values of the 2,141 clips of the sets in `data/persons.yaml`.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from memmlp.motion.body import FPS, JOINTS

MOST_FRAMES = 5 * 60 * FPS  # the rest of a longer clip is not checked
SEGMENTS = (  # ends of body segments, and their fractions of the mass (Winter, Biomechanics, 2009)
    ("neck", "head", 0.081), ("pelvis", "neck", 0.497),
    *((f"{side}_{start}", f"{side}_{end}", mass) for side in ("left", "right") for start, end, mass in (
        ("shoulder", "elbow", 0.028), ("elbow", "wrist", 0.022), ("hip", "knee", 0.1),
        ("knee", "ankle", 0.0465), ("ankle", "foot", 0.0145),
    )),
)  # fmt: skip
HIPS, ANKLES, TOES = ([JOINTS.index(f"{s}_{j}") for s in ("left", "right")] for j in ("hip", "ankle", "foot"))

STEP, FEWEST = 0.5, 4  # metres and number: shorter or fewer steps show no rate
SWINGING = 0.15  # a foot swings above this fraction of its fast speed (95 % quantile)
SLOWEST_SWING = 0.05  # m/s
RUNNING = 0.35  # a walker's other foot moves in less than this fraction of a swing
SHORTEST_SWINGS = 0.30, 0.22  # seconds, walking and running; measured: 0.33 and 0.25
LONGEST_SWING = 1.15  # seconds; measured: 0.95

GRAVITY = 9.81  # m/s^2
RAISED = 0.06  # metres of all joints above their usual lowest place in a flight
FLIGHT, RISE, MISFIT = 0.1, 0.02, 0.05  # seconds and metres at least; deviation from a parabola per height
FLIGHTS = 2
MOST_GRAVITY, SLOW_GRAVITY = 2.5, (0.15, 0.4)  # multiples of gravity; measured in flights: 0.6 to 1.8

TURNING, TURNS = 0.15, 0.3  # m/s of the hip line, and seconds with such turns
SLIDING = 2.0  # ratio of the feet's speed to that with exchanged legs; measured: 1.6


def find_dynamic_faults(positions: np.ndarray, fps: float, clip_fps: float) -> Iterator[str]:
    """Yield descriptions of a wrong rate and of exchanged legs.

    Args:
        positions: joint positions (N, 22, 3), metres, world (Z up), with N > 1.
        fps: rate of the positions, Hz.
        clip_fps: rate of the clip, Hz, for messages.
    """
    label = f"so the frame rate {clip_fps:g} Hz may be"
    swings = np.array(_measure_swings(positions, fps)).reshape(-1, 3)
    if len(swings) >= FEWEST:
        seconds, metres, shared = np.median(swings, axis=0)
        steps = f"a foot swings {metres:.1f} m in {seconds:.2f} s"
        if seconds < SHORTEST_SWINGS[int(shared >= RUNNING)]:
            yield f"{steps}, faster than people step, {label} about twice the true rate or more"
        elif seconds > LONGEST_SWING:
            yield f"{steps}, slower than people step, {label} about half the true rate or less"
    falls = np.array(_measure_falls(positions, fps))
    if len(falls) >= FLIGHTS:
        jumps = f"the body falls with {np.median(falls):.1f} times the acceleration of gravity"
        low, high = SLOW_GRAVITY
        if falls.min() > MOST_GRAVITY:
            yield f"{jumps}, {label} too high"
        elif low < np.median(falls) < high and falls.max() < 1.5 * high:
            yield f"{jumps}, {label} too low"
    if (ratio := _compare_sliding(positions, fps)) > SLIDING:
        slide = f"the feet slide {ratio:.1f} times as far as with exchanged legs"
        yield f"{slide}, so left and right legs may be swapped"


def _find_runs(is_on: np.ndarray) -> np.ndarray:
    """Return the first frames of runs of true values, and the frames after them (runs, 2)."""
    return np.flatnonzero(np.diff(np.concatenate([[0], is_on.astype(int), [0]]))).reshape(-1, 2)


def _measure_swings(positions: np.ndarray, fps: float) -> list[tuple[float, float, float]]:
    """Return duration, length and the fraction in which the other foot moves, of each whole long swing."""
    feet = (positions[:, ANKLES] + positions[:, TOES]) / 2
    speed = np.linalg.norm(np.gradient(feet, axis=0), axis=-1) * fps
    moving = speed > np.maximum(SWINGING * np.quantile(speed, 0.95, axis=0), SLOWEST_SWING)
    both = moving.all(1)
    return [
        ((end - start) / fps, length, float(both[start:end].mean()))
        for foot in (0, 1)
        for start, end in _find_runs(moving[:, foot])
        if start > 0
        and end < len(feet)
        and (length := float(np.linalg.norm((feet[end - 1] - feet[start])[foot, :2]))) > STEP
    ]


def _measure_falls(positions: np.ndarray, fps: float) -> list[float]:
    """Return the downward acceleration of the centre of mass in each flight, in multiples of gravity."""
    ends = [[JOINTS.index(name) for name in segment[:2]] for segment in SEGMENTS]
    masses = np.array([mass for _, _, mass in SEGMENTS])
    height = positions[:, ends, 2].mean(-1) @ masses / masses.sum()
    lowest = positions[:, :, 2].min(1)
    falls = []
    for start, end in _find_runs(lowest > np.quantile(lowest, 0.05) + RAISED):
        path, seconds = height[start:end], np.arange(end - start) / fps
        if len(path) < 6 or seconds[-1] < FLIGHT or np.ptp(path) < RISE:
            continue
        parabola = np.polyfit(seconds, path, 2)
        if np.std(path - np.polyval(parabola, seconds)) < MISFIT * np.ptp(path):
            falls.append(float(-2 * parabola[0] / GRAVITY))
    return falls


def _compare_sliding(positions: np.ndarray, fps: float) -> float:
    """Return the speed of the slower foot while the pelvis turns, relative to that with exchanged legs."""
    hips, toes = positions[:, HIPS], positions[:, TOES]
    turning = np.linalg.norm(np.diff(hips[:, 0] - hips[:, 1], axis=0), axis=-1) * fps > TURNING
    if turning.sum() < TURNS * fps:
        return 0.0

    def measure_speed(feet: np.ndarray) -> float:
        speed = np.linalg.norm(np.diff(feet[:, :, :2], axis=0), axis=-1).min(1) * fps
        return float(np.median(speed[turning]))

    return measure_speed(toes) / (measure_speed(hips[:, ::-1] + toes - hips) + 1e-3)
