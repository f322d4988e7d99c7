"""Standing, walking and running: a person's style, foot steps, and body motion by the phase of a gait."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from memmlp.motion.synthetic.puppet import (
    Array,
    Feet,
    FootStep,
    Puppet,
    apply_foot_steps,
    make_ease,
    make_pulse,
    make_wander,
    smooth,
)

GRAVITY = 9.81
STANDING = 0.992  # metres: height of the root with nearly straight legs
FOLLOW = 0.3  # seconds within which the pelvis follows the feet
LEFT_RIGHT = np.array([1.0, -1.0])


@dataclass(frozen=True)
class Style:
    """The style of a person; metres, radians."""

    origin: Array  # start position (2,), world
    heading: float  # start direction of the person, world
    width: float  # half the distance between the feet
    splay: float  # outward angle of each foot
    lean: float  # forward lean of the spine
    look: float  # pitch of the gaze, positive down
    swing: float  # factor on the swing of the arms
    # positions (2, 3) of the wrists relative to the shoulders, with hanging arms: outward, up, forward
    hands: Array
    uneven: Array  # factors (2,) on the amplitudes of left and right

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Style:
        out, bent = rng.uniform(0.05, 0.14), rng.uniform(0.0, 0.05)
        hands = np.array([[out, -0.515 + bent, 0.03 + bent]] * 2) + rng.normal(0, 0.012, (2, 3))
        return cls(
            origin=rng.uniform(-2.0, 2.0, 2),
            heading=rng.uniform(-np.pi, np.pi),
            width=rng.uniform(0.07, 0.13),
            splay=rng.uniform(0.03, 0.25),
            lean=rng.normal(0.03, 0.05),
            look=rng.normal(0.05, 0.08),
            swing=rng.uniform(0.5, 1.4),
            hands=hands,
            uneven=1.0 + rng.normal(0.0, 0.08, 2),
        )


def compute_direction(yaw: float | Array) -> Array:
    """Return unit vectors (..., 2) on the floor, given angles in radians."""
    return np.stack([np.cos(yaw), np.sin(yaw)], -1)


@dataclass(frozen=True)
class FootPlacement:
    """Positions of both feet on the floor around a centre (2,). The left foot is ahead by `stagger`."""

    center: Array
    heading: float
    width: float
    splay: float
    stagger: float = 0.0

    @property
    def places(self) -> Array:
        """Positions (2, 2) below the ankles, world."""
        along, left = compute_direction(self.heading), compute_direction(self.heading + np.pi / 2)
        return self.center + LEFT_RIGHT[:, None] * (self.width * left + self.stagger * along)

    @property
    def yaws(self) -> Array:
        """Directions (2,) of the feet, world."""
        return self.heading + LEFT_RIGHT * self.splay


@dataclass
class Footwork:
    """A sequence of stance changes, collected as steps."""

    start: FootPlacement
    steps: list[FootStep] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.stance = self.start

    def change_stance(
        self,
        off: float,
        duration: float,
        delay: float,
        shift: Array,
        turn: float,
        first: int = 0,
        **step: Any,
    ) -> None:
        """Move both feet to a new stance, one after the other. The first foot (0 left, 1 right) leaves the
        floor at `off`, is in the air for `duration`, and the second follows after `delay`, all in seconds.
        `shift` is the translation of the stance's centre (2,), metres, world, `turn` the change of its
        heading, radians; `step` has further attributes of FootStep."""
        old = self.stance
        s = self.stance = replace(old, center=old.center + shift, heading=old.heading + turn)
        for foot, start in ((first, off), (1 - first, off + delay)):
            self.steps.append(FootStep(foot, start, start + duration, s.places[foot], s.yaws[foot], **step))


def stand(rng: np.random.Generator, t: Array, style: Style, work: Footwork | None = None) -> Puppet:
    """Make a standing person with hanging arms and a little sway, whose body follows the feet."""
    fps = 1.0 / (t[1] - t[0])
    work = work or Footwork(FootPlacement(style.origin, style.heading, style.width, style.splay))
    feet = apply_foot_steps(t, work.start.places, work.start.yaws, work.steps)
    frames = round(FOLLOW * fps)
    heading = smooth(feet.yaw.mean(1), frames) + 0.02 * make_wander(rng, t)
    ground = feet.ground[..., :2]
    load = smooth((feet.planted @ LEFT_RIGHT)[:, None] * (ground[:, 0] - ground[:, 1]), frames)
    pelvis = np.empty((len(t), 3))
    pelvis[:, :2] = smooth(ground.mean(1), frames) + 0.3 * load + 0.012 * make_wander(rng, t, (2,), high=0.5)
    pelvis[:, :2] += 0.02 * compute_direction(heading)
    pelvis[:, 2] = STANDING + 0.003 * make_wander(rng, t)
    spine = 0.02 * make_wander(rng, t, (3,), high=0.6)
    spine[:, 0] += style.lean
    return Puppet(
        fps=fps,
        heading=heading,
        pelvis=pelvis,
        settle=0.12,
        tilt=0.015 * make_wander(rng, t, (3,), high=0.6),
        spine=spine,
        gaze=[style.look, 0.0] + make_wander(rng, t, (2,), high=0.4) * [0.05, 0.1],
        feet=feet,
        hands=style.hands + 0.012 * make_wander(rng, t, (2, 3), high=0.7),
        wrists=0.06 * make_wander(rng, t, (2, 3)),
    )


def draw_occasions(
    rng: np.random.Generator, t: Array, length: tuple[float, float], pause: tuple[float, float]
) -> Iterator[tuple[float, float]]:
    """Draw successive events with pauses at the times t (N,), and yield their start and end. The ranges of
    their lengths and pauses are in seconds."""
    start = t[0] + rng.uniform(0.0, max(pause))
    while (end := start + rng.uniform(*length)) < t[-1]:
        yield start, end
        start = end + rng.uniform(*pause)


def move_hand(puppet: Puppet, side: int, target: Array, weight: Array) -> None:
    """Move a wrist towards `target` (3,) or (N, 3) by `weight` (N,) in [0, 1], on an arc before the body."""
    w = weight[:, None]
    hand = puppet.hands[:, side]
    hand += w * (target - hand) + w * (1 - w) * np.array([0.15, 0.0, 0.5])


def bend_knees(puppet: Puppet, depth: Array) -> None:
    """Lower the pelvis by `depth` (N,), metres. Pelvis and trunk keep the balance."""
    puppet.pelvis[:, 2] -= depth
    puppet.pelvis[:, :2] -= 0.25 * depth[:, None] * compute_direction(puppet.heading)
    puppet.tilt[:, 0] += 0.9 * depth
    puppet.spine[:, 0] += 0.5 * depth
    puppet.gaze[:, 0] += 0.3 * depth


# Gaits


@dataclass(frozen=True)
class Gait:
    """The parameters of a gait; metres, seconds, radians. A cycle is two steps."""

    speed: tuple[float, float]  # range of the full speed, m/s
    cadence: tuple[float, float]  # cycles per second at speed zero, and their increase per m/s
    duty: float  # fraction of the cycle in which a foot is on the floor
    ahead: float  # fraction of the contact before the pelvis is over the foot
    turn: float  # maximum angle of one turn of the path
    width: float  # factor on the distance between the feet
    sink: float  # lowering of the pelvis relative to standing
    bounce: float  # amplitude of the pelvis height
    lift: float  # lift, heel, toe and push as in FootStep; push in cycles
    heel: float
    toe: float
    push: float
    lean: float  # forward lean of the spine
    yaw: float  # amplitude of the pelvis rotation at full speed
    swing: float  # amplitude of the hands' swing at full speed
    elbow: tuple[float, float]  # displacement of the hands by bent arms: up, forward
    settle: float  # as in Puppet


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
    """The path of a gait over N frames."""

    path: Array  # positions (N, 2), metres, world
    heading: Array  # directions (N,), radians, world
    pace: Array  # speeds (N,), m/s
    phase: Array  # phases (N,), cycles
    go: Array  # 0 for standing to 1 for moving (N,)


def draw_walking(rng: np.random.Generator, t: Array) -> Puppet:
    """Draw walking with turns, and sometimes a raised hand."""
    puppet = _draw_locomotion(rng, t, WALK)
    if rng.random() < 0.3:
        side, target = int(rng.integers(2)), rng.uniform([0.0, -0.2, 0.2], [0.15, 0.1, 0.35])
        for start, end in draw_occasions(rng, t, (2.0, 5.0), (1.0, 5.0)):
            move_hand(puppet, side, target, make_pulse(t, start, start + 0.9, end - 0.9, end))
    return puppet


def draw_running(rng: np.random.Generator, t: Array) -> Puppet:
    return _draw_locomotion(rng, t, RUN)


def _draw_locomotion(rng: np.random.Generator, t: Array, gait: Gait) -> Puppet:
    style = Style.draw(rng)
    course = _draw_course(rng, t, gait, style)
    puppet = stand(rng, t, style)
    puppet.feet = _make_foot_paths(t, gait, style, course)
    puppet.settle = gait.settle
    puppet.heading = course.heading + 0.02 * make_wander(rng, t)
    puppet.pelvis += np.c_[course.path - style.origin, np.zeros(len(t))]
    _move_pelvis(puppet, gait, style, course)
    _swing_along(puppet, gait, style, course)
    return puppet


def _draw_course(rng: np.random.Generator, t: Array, gait: Gait, style: Style) -> Course:
    """Draw a course that starts and ends with standing, with motion and turns in between."""
    fps = 1.0 / (t[1] - t[0])
    start, stop = t[0] + rng.uniform(0.3, 1.2), t[-1] - rng.uniform(1.2, 2.0)
    top = rng.uniform(*gait.speed)
    go = make_ease(t, start, start + 1.2) * (1 - make_ease(t, stop - 1.2, stop))
    pace = top * go * (1 + 0.05 * make_wander(rng, t, high=0.4))
    heading = style.heading + 0.06 * go * make_wander(rng, t, high=0.3)
    for a, b in draw_occasions(rng, t, (1.6, 3.0), (0.5, 4.0)):
        heading = heading + rng.uniform(-gait.turn, gait.turn) * make_ease(t, a, b)
    path = style.origin + np.cumsum(pace[:, None] * compute_direction(heading), 0) / fps
    cadence = (gait.cadence[0] + gait.cadence[1] * pace) * (1 + 0.02 * make_wander(rng, t))
    stepping = make_pulse(t, start - 0.1, start + 0.3, stop + 0.3, stop + 0.9)
    phase = gait.duty - 0.02 + rng.choice([0.0, 0.5]) + np.cumsum(cadence * stepping) / fps
    return Course(path, heading, pace, phase, go)


def _make_foot_paths(t: Array, gait: Gait, style: Style, course: Course) -> Feet:
    """Make the paths of the feet. The left foot touches down at whole phases, the right one half a cycle
    later."""
    start = FootPlacement(style.origin, float(course.heading[0]), style.width, style.splay)
    steps = []
    for side in (0, 1):
        first = np.ceil(course.phase[0] + 1 - gait.duty - side / 2) + side / 2
        strikes = np.arange(first, course.phase[-1])
        steps += [_make_step(t, gait, style, course, side, strike) for strike in strikes]
    return apply_foot_steps(t, start.places, start.yaws, steps)


def _make_step(t: Array, gait: Gait, style: Style, course: Course, side: int, strike: float) -> FootStep:
    phases = [strike - 1 + gait.duty, strike, strike + gait.ahead * gait.duty]
    off, on, over = np.interp(phases, course.phase, t)
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


def _move_pelvis(puppet: Puppet, gait: Gait, style: Style, course: Course) -> None:
    """Move the pelvis over the standing foot, up and down twice per cycle, and lean into turns."""
    cycle = 2 * np.pi * course.phase
    left = compute_direction(course.heading + np.pi / 2)
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
    """Rotate the shoulders opposite to the pelvis, swing the hands, and look ahead in turns."""
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
