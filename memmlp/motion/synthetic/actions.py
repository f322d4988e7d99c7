"""Actions on the spot: squat, sit, reach, wave, box, jump, step sideways, look around.

Each public function draws a performance at the times t (N,), in seconds.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from memmlp.motion.synthetic.gait import (
    GRAVITY,
    LEFT_RIGHT,
    FootPlacement,
    Footwork,
    Style,
    bend_knees,
    direction,
    move_hand,
    occasions,
    stand,
)
from memmlp.motion.synthetic.puppet import Array, Puppet, arc, ease, pulse, wander

ARM = 0.53  # metres, shoulder to wrist
# Where the hands are from the shoulders (outward, up, forward, metres): ahead, before the chest, hanging.
SQUAT_HANDS = ((-0.05, 0.0, 0.45), (-0.16, -0.12, 0.3), (0.12, -0.5, 0.1))
GUARD = ((-0.03, 0.02, 0.3), (-0.05, 0.0, 0.22))  # of the leading hand and the hand at the chin
PUNCHES = {  # the target: outward, up, forward along the heading, metres; how far the body turns in, radians
    "straight": (np.array([-0.12, 0.06, 0.49]), 0.45),
    "hook": (np.array([-0.1, 0.05, 0.36]), 0.6),
    "uppercut": (np.array([-0.12, 0.12, 0.33]), 0.35),
    "body": (np.array([-0.12, -0.25, 0.44]), 0.5),
}


def squatting(rng: np.random.Generator, t: Array) -> Puppet:
    """Squat to one person's depth, the arms as a counterweight."""
    style = Style.draw(rng)
    puppet = stand(rng, t, replace(style, width=style.width + 0.06, splay=style.splay + 0.2))
    target, depth = np.array(SQUAT_HANDS[rng.integers(3)]), rng.uniform(0.2, 0.42)
    for start, end in occasions(rng, t, (1.8, 3.4), (0.1, 1.5)):
        down, up = start + rng.uniform(0.35, 0.48) * (end - start), end - 0.45 * (end - start)
        weight = pulse(t, start, down, up, end)
        bend_knees(puppet, rng.uniform(0.8, 1.1) * depth * weight)
        for side in (0, 1):
            move_hand(puppet, side, target, weight)
    return puppet


def sitting(rng: np.random.Generator, t: Array) -> Puppet:
    """Sit down on a seat of one height and stand up again, the hands on the thighs or talking."""
    style = Style.draw(rng)
    puppet = stand(rng, t, style)
    drop, back = rng.uniform(0.4, 0.5), rng.uniform(0.34, 0.42)
    lap = np.array([-0.04, -0.36, 0.24]) + rng.normal(0, 0.03, 3)
    for start, end in occasions(rng, t, (4.5, 9.0), (0.8, 2.5)):
        down, up = start + rng.uniform(1.3, 2.0), end - rng.uniform(1.2, 1.8)
        seated = pulse(t, start, down, up, end)
        puppet.pelvis[:, 2] -= drop * seated
        puppet.pelvis[:, :2] -= back * seated[:, None] * direction(puppet.heading)
        rocking = arc(t, start, down + 0.3) + arc(t, up - 0.3, end)
        puppet.tilt[:, 0] += rng.uniform(0.4, 0.6) * rocking
        puppet.spine[:, 0] += 0.3 * rocking + rng.uniform(-0.05, 0.2) * seated
        talking = ease(t, down, down + 0.5) * (1 - ease(t, up - 0.5, up))
        for side in (0, 1):
            move_hand(puppet, side, lap, pulse(t, start + 0.2, down + 0.2, up - 0.1, end))
            lively = rng.uniform(0.3, 1.0) * np.array([0.04, 0.1, 0.04])
            move_hand(puppet, side, lap + [0, 0.04, 0] + lively * wander(rng, t, (3,), high=0.8), talking)
    return puppet


def reaching(rng: np.random.Generator, t: Array) -> Puppet:
    """Reach with one or both hands to targets high, low, ahead and aside."""
    puppet = stand(rng, t, Style.draw(rng))
    for start, end in occasions(rng, t, (1.8, 3.5), (0.1, 1.0)):
        hold = rng.uniform(0.1, 0.25) * (end - start)
        middle = 0.5 * (start + end)
        weight = pulse(t, start, middle - hold, middle + hold, end)
        elevation = rng.uniform(-1.2, 1.2)
        sides = ((0,), (1,), (0, 1))[rng.integers(3)]
        outward = rng.uniform(-0.4, 1.3) if len(sides) == 1 else rng.uniform(-0.1, 0.3)
        _reach(puppet, sides, outward, elevation, rng.uniform(0.75, 0.97), weight)
    return puppet


def _reach(
    puppet: Puppet, sides: tuple[int, ...], outward: float, elevation: float, part: float, weight: Array
) -> None:
    """Bring hands towards a target, the trunk, knees and gaze helping.

    Outward and elevation are the target's angles (radians) from straight ahead and above the shoulder; `part`
    is its distance in arm's lengths. The weight (N,) is how far the hands have got, in [0, 1].
    """
    turn = sum(LEFT_RIGHT[side] for side in sides)  # a lone hand's shoulder is brought along
    low, high = max(-elevation, 0.0), max(elevation, 0.0)
    bend_knees(puppet, 0.22 * low**2 * weight)
    puppet.spine[:, 0] += (0.4 * low - 0.12 * high) * weight
    puppet.spine[:, 1] += turn * (0.45 * outward - 0.2) * weight
    puppet.spine[:, 2] += turn * 0.15 * np.sin(elevation) * weight
    puppet.tilt[:, 1] += turn * 0.15 * outward * weight
    puppet.gaze += np.outer(weight, [-0.5 * elevation, turn * 0.7 * outward])
    puppet.feet.heel += 0.3 * (high**2 * weight)[:, None]
    puppet.pelvis[:, 2] += 0.03 * high**2 * weight
    level = part * ARM * np.cos(elevation)
    target = np.array([level * np.sin(outward), part * ARM * np.sin(elevation), level * np.cos(outward)])
    for side in sides:
        move_hand(puppet, side, target, weight)
        puppet.wrists[:, side, 0] += 0.6 * weight


def waving(rng: np.random.Generator, t: Array) -> Puppet:
    """Wave with one hand or both, at the person's own height, rate and width."""
    puppet = stand(rng, t, Style.draw(rng))
    sides = ((0,), (1,), (0, 1))[rng.choice(3, p=[0.4, 0.4, 0.2])]
    raised = rng.uniform([0.1, 0.05, 0.12], [0.3, 0.4, 0.25])
    rate, width = rng.uniform(0.9, 2.0), rng.uniform(0.04, 0.1)
    for start, end in occasions(rng, t, (2.5, 6.0), (0.4, 2.0)):
        weight = pulse(t, start, start + 0.8, end - 0.8, end)
        beat = 2 * np.pi * rate * (t - start) + 0.5 * wander(rng, t)
        puppet.spine[:, 2] += 0.015 * len(sides) * weight * np.sin(beat)
        for side in sides:
            aside = width * np.sin(beat + side * rng.uniform(-0.3, 0.3))
            target = raised + np.stack([aside, -0.3 * np.abs(aside) ** 2 / width, np.zeros_like(t)], -1)
            move_hand(puppet, side, target, weight)
            puppet.wrists[:, side, 2] += 3.0 * aside * weight
    return puppet


def punching(rng: np.random.Generator, t: Array) -> Puppet:
    """Punch in combinations from a boxer's stance, with small steps and a bounce."""
    style = Style.draw(rng)
    lead = int(rng.integers(2))
    bladed = -LEFT_RIGHT[lead] * rng.uniform(0.3, 0.6)
    stagger = LEFT_RIGHT[lead] * rng.uniform(0.12, 0.2)
    work = Footwork(FootPlacement(style.origin, style.heading, style.width + 0.04, style.splay, stagger))
    for start, _ in occasions(rng, t, (0.8, 1.5), (0.5, 3.0)):
        shift, turn = rng.uniform(-0.2, 0.2, 2), rng.uniform(-0.3, 0.3)
        work.change(start, 0.28, 0.32, shift, turn, first=int(rng.integers(2)), lift=0.03)
    puppet = stand(rng, t, style, work)
    puppet.tilt[:, 1] += bladed
    bend_knees(puppet, 0.06 + 0.012 * np.sin(2 * np.pi * rng.uniform(1.2, 2.0) * t + wander(rng, t)))
    for side in (0, 1):
        move_hand(puppet, side, np.array(GUARD[side != lead]), np.ones_like(t))
    blows = _blows(rng, t, lead)
    for side, start, reach, end, kind in blows:
        weight = pulse(t, start, reach, reach, end)
        puppet.spine[:, 1] -= LEFT_RIGHT[side] * PUNCHES[kind][1] * 0.6 * weight
        puppet.tilt[:, 1] -= LEFT_RIGHT[side] * PUNCHES[kind][1] * 0.5 * weight
        puppet.feet.heel[:, side] += 0.3 * weight * (side != lead)
    for side, start, reach, end, kind in blows:
        weight = pulse(t, start, reach, reach, end)
        move_hand(puppet, side, _aimed(puppet, side, PUNCHES[kind][0]), weight)
        puppet.wrists[:, side, 0] += weight
    return puppet


def _blows(rng: np.random.Generator, t: Array, lead: int) -> list[tuple[int, float, float, float, str]]:
    """Draw combinations of punches, the hands in turn.

    Returns:
        For each punch the side, the times (seconds) of start, reach and end, and the kind.
    """
    blows = []
    for start, end in occasions(rng, t, (0.7, 2.2), (0.3, 1.5)):
        side, now = lead if rng.random() < 0.7 else 1 - lead, start
        while now < end:
            out, back = rng.uniform(0.18, 0.28), rng.uniform(0.28, 0.4)
            blows.append((side, now, now + out, now + out + back, str(rng.choice(list(PUNCHES)))))
            now, side = now + out + rng.uniform(0.6, 1.1) * back, 1 - side
    return blows


def _aimed(puppet: Puppet, side: int, target: Array) -> Array:
    """Convert a target (3,) relative to the heading to the same point relative to the turned trunk (N, 3)."""
    yaw = LEFT_RIGHT[side] * (puppet.tilt[:, 1] + puppet.spine[:, 1])
    out, up, forward = target
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return np.stack([out * cosine - forward * sine, np.full_like(yaw, up), forward * cosine + out * sine], -1)


def jumping(rng: np.random.Generator, t: Array) -> Puppet:
    """Jump on the spot, ahead, aside and with a turn: crouch, take-off, flight, landing."""
    style = Style.draw(rng)
    work = Footwork(FootPlacement(style.origin, style.heading, style.width + 0.02, style.splay))
    height, leaps = rng.uniform(0.1, 0.35), []
    for start, _ in occasions(rng, t, (2.3, 2.6), (0.0, 1.5)):
        rise, off = height * rng.uniform(0.8, 1.1), start + rng.uniform(0.7, 0.9)
        flight = np.sqrt(8 * rise / GRAVITY)
        shift, turn = rng.uniform(-0.3, 0.3, 2) * rng.integers(2), rng.uniform(-0.9, 0.9) * rng.integers(2)
        work.change(off, flight, 0.0, shift, turn, lift=rise + 0.08, heel=0.9, toe=0.0, push=0.2)
        leaps.append((start, off, off + flight, rng.uniform(0.18, 0.3)))
    puppet = stand(rng, t, style, work)
    puppet.settle = 0.03
    for leap in leaps:
        _leap(puppet, t, style.swing, *leap)
    return puppet


def _leap(puppet: Puppet, t: Array, swing: float, start: float, off: float, on: float, depth: float) -> None:
    """Move the pelvis through one jump, the trunk with it, and the arms to help.

    Start of the crouch, take-off (`off`) and landing (`on`) are in seconds, the crouch's depth in metres.
    """
    low, deep, end, speed = off - 0.28, on + 0.22, on + 0.9, GRAVITY * (on - off) / 2
    heights, speeds = [0, -depth, -0.04, -0.08, -0.7 * depth, 0], [0, 0, speed, -speed, 0, 0]
    inside = (t > start) & (t < end)
    path = CubicHermiteSpline([start, low, off, on, deep, end], heights, speeds)
    puppet.pelvis[inside, 2] += path(t[inside])
    crouch = pulse(t, start, low, low, off) + 0.7 * pulse(t, on, deep, deep, end)
    puppet.pelvis[:, :2] -= 0.3 * depth * crouch[:, None] * direction(puppet.heading)
    puppet.tilt[:, 0] += 1.8 * depth * crouch
    puppet.spine[:, 0] += 1.0 * depth * crouch
    back, ahead = np.array([0.12, -0.44, -0.25]), np.array([0.1, 0.15 * swing, 0.4])
    for side in (0, 1):
        move_hand(puppet, side, back, swing / 1.5 * pulse(t, start, low - 0.05, low, off - 0.02))
        move_hand(puppet, side, ahead, pulse(t, low, off + 0.05, off + 0.1, deep + 0.2))


def sidestepping(rng: np.random.Generator, t: Array) -> Puppet:
    """Step to the left and the right: the leading foot goes, the other follows."""
    style = Style.draw(rng)
    work = Footwork(FootPlacement(style.origin, style.heading, style.width + 0.02, style.splay))
    pace, tempo = rng.uniform(0.15, 0.38), rng.uniform(0.38, 0.55)
    now, first = rng.uniform(0.2, 1.0), int(rng.integers(2))
    while now < t[-1]:
        for _ in range(rng.integers(2, 6)):
            way = work.stance.heading + LEFT_RIGHT[first] * np.pi / 2 + rng.uniform(-0.3, 0.3)
            shift = pace * rng.uniform(0.85, 1.15) * direction(way)
            turn = rng.uniform(-0.15, 0.15)
            work.change(now, tempo, tempo + 0.06, shift, turn, first, lift=0.05, heel=0.3, push=0.2)
            now += 2 * tempo + 0.15
        now, first = now + rng.uniform(0.2, 1.0), 1 - first
    puppet = stand(rng, t, style, work)
    bend_knees(puppet, np.full_like(t, rng.uniform(0.02, 0.08)))
    puppet.hands[:, :, 0] += rng.uniform(0.0, 0.1)
    puppet.hands[:, :, 1:] += rng.uniform(0.0, 0.15)
    return puppet


def idling(rng: np.random.Generator, t: Array) -> Puppet:
    """Stand, shift the weight, look around, and now and then turn on the spot."""
    style = Style.draw(rng)
    work = Footwork(FootPlacement(style.origin, style.heading, style.width, style.splay))
    for start, _ in occasions(rng, t, (1.6, 2.0), (2.0, 6.0)):
        turn = rng.uniform(-0.9, 0.9)
        first = int(turn < 0)
        work.change(start, 0.5, 0.6, rng.uniform(-0.08, 0.08, 2), turn, first, lift=0.04, heel=0.3, push=0.25)
    puppet = stand(rng, t, style, work)
    shift = 0.04 * wander(rng, t, low=0.05, high=0.25)
    puppet.pelvis[:, :2] += shift[:, None] * direction(puppet.heading + np.pi / 2)
    puppet.tilt[:, 2] += 0.8 * shift
    puppet.spine[:, 2] -= 0.8 * shift
    for start, end in occasions(rng, t, (1.5, 4.0), (0.2, 2.0)):
        look = pulse(t, start, start + rng.uniform(0.5, 0.7), end - 0.7, end)
        pitch, yaw = rng.uniform([-0.5, -1.2], [0.5, 1.2])
        puppet.gaze += np.outer(look, [pitch, yaw])
        puppet.spine[:, 1] += 0.3 * yaw * look
    return puppet
