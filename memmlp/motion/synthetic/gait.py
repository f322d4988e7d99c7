"""Walking and running: a path, a phase, the positions of the feet, and a body that moves with the phase."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from memmlp.motion.synthetic.curves import Array, ease, pulse, smooth, wander
from memmlp.motion.synthetic.puppet import Puppet
from memmlp.motion.synthetic.standing import FootPlacement, Style, direction, move_hand, occasions, stand
from memmlp.motion.synthetic.steps import Feet, FootStep, tread

GRAVITY = 9.81


@dataclass(frozen=True)
class Gait:
    """A gait; metres, seconds, radians. A cycle is two steps.

    Attributes:
        speed: range of the full speed, m/s.
        cadence: cycles per second at zero speed, and the increase for each m/s.
        duty: part of the cycle during which a foot is on the floor.
        ahead: part of the contact that passes before the pelvis is over the foot.
        turn: largest turn of the path at one time.
        width: factor on the distance of the feet.
        sink: how much lower the pelvis is than in standing.
        bounce: amplitude of the pelvis' height.
        lift: see FootStep.
        heel: see FootStep.
        toe: see FootStep.
        push: see FootStep, here in cycles.
        lean: forward lean of the spine.
        yaw: amplitude of the pelvis' turn at full speed.
        swing: amplitude of the hands' swing at full speed.
        elbow: how far the bent arms bring the hands up and forward.
        settle: see Puppet.
    """

    speed: tuple[float, float]
    cadence: tuple[float, float]
    duty: float
    ahead: float
    turn: float
    width: float
    sink: float
    bounce: float
    lift: float
    heel: float
    toe: float
    push: float
    lean: float
    yaw: float
    swing: float
    elbow: tuple[float, float]
    settle: float


WALK = Gait(
    speed=(0.6, 1.8), cadence=(0.52, 0.33), duty=0.62, ahead=0.4, turn=2.0, width=0.8,
    sink=0.012, bounce=0.006, lift=0.05, heel=0.9, toe=0.28, push=0.24,
    lean=0.02, yaw=0.11, swing=0.2, elbow=(0.02, 0.02), settle=0.11,
)  # fmt: skip
RUN = Gait(
    speed=(2.0, 3.8), cadence=(1.2, 0.08), duty=0.29, ahead=0.38, turn=1.0, width=0.45,
    sink=0.06, bounce=0.03, lift=0.18, heel=0.85, toe=0.15, push=0.2,
    lean=0.14, yaw=0.14, swing=0.16, elbow=(0.24, 0.16), settle=0.07,
)  # fmt: skip


@dataclass(frozen=True)
class Course:
    """The path of a gait over N frames.

    Attributes:
        path: positions (N, 2), metres, world.
        heading: directions (N,), radians, world.
        pace: speeds (N,), m/s.
        phase: phases (N,), cycles.
        go: 0 while standing and 1 while moving (N,).
    """

    path: Array
    heading: Array
    pace: Array
    phase: Array
    go: Array


def walking(rng: np.random.Generator, t: Array) -> Puppet:
    """Walk with turns; now and then one hand is raised."""
    puppet = _locomotion(rng, t, WALK)
    if rng.random() < 0.3:
        side, target = int(rng.integers(2)), rng.uniform([0.0, -0.2, 0.2], [0.15, 0.1, 0.35])
        for start, end in occasions(rng, t, (2.0, 5.0), (1.0, 5.0)):
            move_hand(puppet, side, target, pulse(t, start, start + 0.9, end - 0.9, end))
    return puppet


def running(rng: np.random.Generator, t: Array) -> Puppet:
    """Run with wide turns."""
    return _locomotion(rng, t, RUN)


def _locomotion(rng: np.random.Generator, t: Array, gait: Gait) -> Puppet:
    """Move with a gait, in one person's style."""
    style = Style.draw(rng)
    course = _course(rng, t, gait, style)
    puppet = stand(rng, t, style)
    puppet.feet = _feet(t, gait, style, course)
    puppet.settle = gait.settle
    puppet.heading = course.heading + 0.02 * wander(rng, t)
    puppet.pelvis += np.c_[course.path - style.origin, np.zeros(len(t))]
    _carry_along(puppet, gait, style, course)
    _swing_along(puppet, gait, style, course)
    return puppet


def _course(rng: np.random.Generator, t: Array, gait: Gait, style: Style) -> Course:
    """Draw a course: stand, move for most of the time with turns, stand."""
    fps = 1.0 / (t[1] - t[0])
    start, stop = t[0] + rng.uniform(0.3, 1.2), t[-1] - rng.uniform(1.2, 2.0)
    top = rng.uniform(*gait.speed)
    go = ease(t, start, start + 1.2) * (1 - ease(t, stop - 1.2, stop))
    pace = top * go * (1 + 0.05 * wander(rng, t, high=0.4))
    heading = style.heading + 0.06 * go * wander(rng, t, high=0.3)
    for a, b in occasions(rng, t, (1.6, 3.0), (0.5, 4.0)):
        heading = heading + rng.uniform(-gait.turn, gait.turn) * ease(t, a, b)
    path = style.origin + np.cumsum(pace[:, None] * direction(heading), 0) / fps
    cadence = (gait.cadence[0] + gait.cadence[1] * pace) * (1 + 0.02 * wander(rng, t))
    stepping = pulse(t, start - 0.1, start + 0.3, stop + 0.3, stop + 0.9)
    phase = gait.duty - 0.02 + rng.choice([0.0, 0.5]) + np.cumsum(cadence * stepping) / fps
    return Course(path, heading, pace, phase, go)


def _feet(t: Array, gait: Gait, style: Style, course: Course) -> Feet:
    """Make the steps: the left foot comes down at every whole phase, the right one half a cycle later."""
    start = FootPlacement(style.origin, float(course.heading[0]), style.width, style.splay)
    steps = []
    for side in (0, 1):
        first = np.ceil(course.phase[0] + 1 - gait.duty - side / 2) + side / 2
        for strike in np.arange(first, course.phase[-1]):
            steps.append(_step(t, gait, style, course, side, strike))
    return tread(t, start.places, start.yaws, steps)


def _step(t: Array, gait: Gait, style: Style, course: Course, side: int, strike: float) -> FootStep:
    """Make the step that ends at phase `strike`; it is small and flat where the pace is low."""
    off, on, over = np.interp(
        [strike - 1 + gait.duty, strike, strike + gait.ahead * gait.duty], course.phase, t
    )
    frame = int(np.searchsorted(t, over).clip(0, len(t) - 1))
    pace = np.interp(0.5 * (off + on), t, course.pace) / gait.speed[1]
    effort = (0.2 + 0.8 * min(1.0, 1.4 * pace)) * style.uneven[side]
    width = style.width * (1 + (gait.width - 1) * course.go[frame])
    stance = FootPlacement(course.path[frame], float(course.heading[frame]), width, 0.7 * style.splay)
    cycle = (on - off) / (1 - gait.duty)
    return FootStep(
        side, off, on, stance.places[side], stance.yaws[side],
        lift=gait.lift * effort, heel=gait.heel * effort, toe=gait.toe * effort,
        push=gait.push * cycle, roll=0.2 * gait.duty * cycle,
    )  # fmt: skip


def _carry_along(puppet: Puppet, gait: Gait, style: Style, course: Course) -> None:
    """Move the pelvis: over the carrying foot, up and down twice a cycle, and leaning into turns."""
    cycle = 2 * np.pi * course.phase
    left = direction(course.heading + np.pi / 2)
    inward = 0.6 * course.pace * np.gradient(course.heading) * puppet.fps / GRAVITY
    inward = smooth(inward, round(0.3 * puppet.fps)).clip(-0.35, 0.35)
    effort = course.go * course.pace / gait.speed[1]
    sway = 0.3 * style.width * course.go * np.sin(cycle - np.pi * gait.duty + np.pi / 2)
    puppet.pelvis[:, :2] += (sway + 0.5 * inward)[:, None] * left
    bounce = gait.bounce * np.cos(2 * (cycle - np.pi * gait.duty))
    puppet.pelvis[:, 2] -= course.go * (gait.sink + bounce)
    puppet.tilt[:, 1] -= gait.yaw * effort * np.cos(cycle)
    puppet.tilt[:, 2] += 0.05 * effort * np.sin(cycle) - inward
    puppet.tilt[:, 0] += 0.4 * gait.lean * effort


def _swing_along(puppet: Puppet, gait: Gait, style: Style, course: Course) -> None:
    """Turn the shoulders against the pelvis, swing the hands against the legs, look ahead into the turn."""
    cycle = 2 * np.pi * course.phase
    effort = course.go * course.pace / gait.speed[1]
    puppet.spine[:, 0] += gait.lean * effort + 0.012 * effort * np.cos(2 * cycle)
    puppet.spine[:, 1] += 2.0 * gait.yaw * effort * np.cos(cycle - 0.2)
    puppet.spine[:, 2] -= 0.04 * effort * np.sin(cycle)
    ahead = np.interp(np.arange(len(cycle)) + 0.5 * puppet.fps, np.arange(len(cycle)), course.heading)
    puppet.gaze[:, 1] += smooth(ahead - course.heading, round(0.2 * puppet.fps)).clip(-0.8, 0.8)
    for side, sign in enumerate((1.0, -1.0)):
        swing = -sign * style.swing * style.uneven[side] * gait.swing * effort * np.cos(cycle - 0.2)
        forward = np.maximum(swing, 0.0) ** 2 / gait.swing
        up, out = gait.elbow
        puppet.hands[:, side, 1] += course.go * up + 0.9 * forward + 0.3 * swing * swing / 0.5
        puppet.hands[:, side, 2] += course.go * out + swing
        puppet.hands[:, side, 0] -= 0.3 * (forward + course.go * 0.1 * up)
