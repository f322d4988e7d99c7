"""A person at rest: personal style, footwork on the spot, and the natural variation of standing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from memmlp.motion.synthetic.curves import Array, smooth, wander
from memmlp.motion.synthetic.puppet import Puppet
from memmlp.motion.synthetic.steps import Feet, FootStep, tread

STANDING = 0.992  # metres, the root's height with nearly straight legs
FOLLOW = 0.3  # seconds within which the pelvis follows the feet
LEFT_RIGHT = np.array([1.0, -1.0])


@dataclass(frozen=True)
class Style:
    """What makes one person's clip differ from another's; metres, radians.

    Attributes:
        origin: where (2,) the clip starts, world.
        heading: in which direction the person faces at the start, world.
        width: half the distance of the feet.
        splay: how far each foot points outward.
        lean: forward lean of the spine.
        look: pitch of the gaze, positive down.
        swing: factor on the arms' swing.
        hands: positions (2, 3) of the wrists when the arms hang, from the shoulders: outward, up, forward.
        uneven: factor (2,) on the amplitude of left and right.
    """

    origin: Array
    heading: float
    width: float
    splay: float
    lean: float
    look: float
    swing: float
    hands: Array
    uneven: Array

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Style:
        """Draw a person's style."""
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


def direction(yaw: float | Array) -> Array:
    """Return unit vectors (..., 2) on the floor."""
    return np.stack([np.cos(yaw), np.sin(yaw)], -1)


@dataclass(frozen=True)
class FootPlacement:
    """Both feet on the floor about a centre (2,): the left one to the left, and ahead by `stagger`."""

    center: Array
    heading: float
    width: float
    splay: float
    stagger: float = 0.0

    @property
    def places(self) -> Array:
        """Positions (2, 2) below the ankles, world."""
        along, left = direction(self.heading), direction(self.heading + np.pi / 2)
        return self.center + LEFT_RIGHT[:, None] * (self.width * left + self.stagger * along)

    @property
    def yaws(self) -> Array:
        """Directions (2,) of the feet, world."""
        return self.heading + LEFT_RIGHT * self.splay


@dataclass
class Footwork:
    """Changes of stance, one after the other, collected as steps."""

    start: FootPlacement
    steps: list[FootStep] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.stance = self.start

    def change(
        self,
        off: float,
        duration: float,
        delay: float,
        shift: Array,
        turn: float = 0.0,
        first: int = 0,
        **how: Any,
    ) -> None:
        """Move both feet to a new stance, one after the other.

        Args:
            off: seconds at which the first foot leaves the floor.
            duration: seconds that each foot is in the air.
            delay: seconds by which the second foot leaves later.
            shift: how far (2,) the stance's centre moves, metres, world.
            turn: how far its heading turns, radians.
            first: the foot that goes first, 0 left, 1 right.
            how: the other attributes of FootStep.
        """
        s = self.stance = replace(
            self.stance, center=self.stance.center + shift, heading=self.stance.heading + turn
        )
        for foot, start in ((first, off), (1 - first, off + delay)):
            self.steps.append(FootStep(foot, start, start + duration, s.places[foot], s.yaws[foot], **how))

    def feet(self, t: Array) -> Feet:
        """Return the feet at the times (N,)."""
        return tread(t, self.start.places, self.start.yaws, self.steps)


def stand(rng: np.random.Generator, t: Array, style: Style, work: Footwork | None = None) -> Puppet:
    """Stand with hanging arms, sway a little, follow the feet; the pelvis goes over the carrying foot."""
    fps = 1.0 / (t[1] - t[0])
    work = work or Footwork(FootPlacement(style.origin, style.heading, style.width, style.splay))
    feet = work.feet(t)
    frames = round(FOLLOW * fps)
    heading = smooth(feet.yaw.mean(1), frames) + 0.02 * wander(rng, t)
    ground = feet.ground[..., :2]
    load = smooth((feet.planted @ LEFT_RIGHT)[:, None] * (ground[:, 0] - ground[:, 1]), frames)
    pelvis = np.empty((len(t), 3))
    pelvis[:, :2] = smooth(ground.mean(1), frames) + 0.3 * load + 0.012 * wander(rng, t, (2,), high=0.5)
    pelvis[:, :2] += 0.02 * direction(heading)
    pelvis[:, 2] = STANDING + 0.003 * wander(rng, t)
    spine = 0.02 * wander(rng, t, (3,), high=0.6)
    spine[:, 0] += style.lean
    return Puppet(
        fps=fps,
        heading=heading,
        pelvis=pelvis,
        settle=0.12,
        tilt=0.015 * wander(rng, t, (3,), high=0.6),
        spine=spine,
        gaze=[style.look, 0.0] + wander(rng, t, (2,), high=0.4) * [0.05, 0.1],
        feet=feet,
        hands=style.hands + 0.012 * wander(rng, t, (2, 3), high=0.7),
        wrists=0.06 * wander(rng, t, (2, 3)),
    )


def occasions(
    rng: np.random.Generator, t: Array, length: tuple[float, float], pause: tuple[float, float]
) -> Iterator[tuple[float, float]]:
    """Yield start and end, in seconds, of events that follow one another with pauses between.

    Args:
        rng: random generator.
        t: times (N,), seconds.
        length: range of an event's length, seconds.
        pause: range of a pause's length, seconds.
    """
    start = t[0] + rng.uniform(0.0, max(pause))
    while (end := start + rng.uniform(*length)) < t[-1]:
        yield start, end
        start = end + rng.uniform(*pause)


def move_hand(puppet: Puppet, side: int, target: Array, weight: Array) -> None:
    """Bring a wrist to `target` (3,) or (N, 3) by `weight` (N,) in [0, 1], on an arc in front of the body."""
    w = weight[:, None]
    hand = puppet.hands[:, side]
    hand += w * (target - hand) + w * (1 - w) * np.array([0.15, 0.0, 0.5])


def bend_knees(puppet: Puppet, depth: Array) -> None:
    """Lower the pelvis by `depth` (N,) metres and keep the balance: pelvis back, trunk forward."""
    puppet.pelvis[:, 2] -= depth
    puppet.pelvis[:, :2] -= 0.25 * depth[:, None] * direction(puppet.heading)
    puppet.tilt[:, 0] += 0.9 * depth
    puppet.spine[:, 0] += 0.5 * depth
    puppet.gaze[:, 0] += 0.3 * depth
