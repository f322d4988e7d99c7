"""Actions on the spot: squat, sit, reach, wave, box, jump, step sideways, look around.

Each public function draws a random performance at the times t (N,), in seconds.
"""

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
    compute_direction,
    draw_occasions,
    move_hand,
    stand,
)
from memmlp.motion.synthetic.puppet import Array, Puppet, make_arc, make_ease, make_pulse, make_wander

ARM = 0.53  # metres from shoulder to wrist
# Hand positions relative to the shoulders (outward, up, forward, metres): ahead, at the chest, hanging.
SQUAT_HANDS = ((-0.05, 0.0, 0.45), (-0.16, -0.12, 0.3), (0.12, -0.5, 0.1))
GUARD = ((-0.03, 0.02, 0.3), (-0.05, 0.0, 0.22))  # the leading hand and the hand at the chin
PUNCHES = {  # target (outward, up, forward along the heading, metres), and turn of the body, radians
    "straight": (np.array([-0.12, 0.06, 0.49]), 0.45),
    "hook": (np.array([-0.1, 0.05, 0.36]), 0.6),
    "uppercut": (np.array([-0.12, 0.12, 0.33]), 0.35),
    "body": (np.array([-0.12, -0.25, 0.44]), 0.5),
}


def draw_squatting(rng: np.random.Generator, t: Array) -> Puppet:
    """Draw squats with the arms as a counterweight. The depth depends on the person."""
    style = Style.draw(rng)
    puppet = stand(rng, t, replace(style, width=style.width + 0.06, splay=style.splay + 0.2))
    target, depth = np.array(SQUAT_HANDS[rng.integers(3)]), rng.uniform(0.2, 0.42)
    for start, end in draw_occasions(rng, t, (1.8, 3.4), (0.1, 1.5)):
        down, up = start + rng.uniform(0.35, 0.48) * (end - start), end - 0.45 * (end - start)
        weight = make_pulse(t, start, down, up, end)
        bend_knees(puppet, rng.uniform(0.8, 1.1) * depth * weight)
        for side in (0, 1):
            move_hand(puppet, side, target, weight)
    return puppet


def draw_sitting(rng: np.random.Generator, t: Array) -> Puppet:
    """Draw a person who sits down and stands up. The hands are on the thighs, or gesture."""
    style = Style.draw(rng)
    puppet = stand(rng, t, style)
    drop, back = rng.uniform(0.4, 0.5), rng.uniform(0.34, 0.42)
    lap = np.array([-0.04, -0.36, 0.24]) + rng.normal(0, 0.03, 3)
    for start, end in draw_occasions(rng, t, (4.5, 9.0), (0.8, 2.5)):
        down, up = start + rng.uniform(1.3, 2.0), end - rng.uniform(1.2, 1.8)
        seated = make_pulse(t, start, down, up, end)
        puppet.pelvis[:, 2] -= drop * seated
        puppet.pelvis[:, :2] -= back * seated[:, None] * compute_direction(puppet.heading)
        rocking = make_arc(t, start, down + 0.3) + make_arc(t, up - 0.3, end)
        puppet.tilt[:, 0] += rng.uniform(0.4, 0.6) * rocking
        puppet.spine[:, 0] += 0.3 * rocking + rng.uniform(-0.05, 0.2) * seated
        talking = make_ease(t, down, down + 0.5) * (1 - make_ease(t, up - 0.5, up))
        for side in (0, 1):
            move_hand(puppet, side, lap, make_pulse(t, start + 0.2, down + 0.2, up - 0.1, end))
            lively = rng.uniform(0.3, 1.0) * np.array([0.04, 0.1, 0.04])
            gesture = lap + [0, 0.04, 0] + lively * make_wander(rng, t, (3,), high=0.8)
            move_hand(puppet, side, gesture, talking)
    return puppet


def draw_reaching(rng: np.random.Generator, t: Array) -> Puppet:
    """Draw a person who reaches for high, low, frontal and lateral targets with one or both hands."""
    puppet = stand(rng, t, Style.draw(rng))
    for start, end in draw_occasions(rng, t, (1.8, 3.5), (0.1, 1.0)):
        hold = rng.uniform(0.1, 0.25) * (end - start)
        middle = 0.5 * (start + end)
        weight = make_pulse(t, start, middle - hold, middle + hold, end)
        elevation = rng.uniform(-1.2, 1.2)
        sides = ((0,), (1,), (0, 1))[rng.integers(3)]
        outward = rng.uniform(-0.4, 1.3) if len(sides) == 1 else rng.uniform(-0.1, 0.3)
        _reach_target(puppet, sides, outward, elevation, rng.uniform(0.75, 0.97), weight)
    return puppet


def _reach_target(
    puppet: Puppet, sides: tuple[int, ...], outward: float, elevation: float, part: float, weight: Array
) -> None:
    """Move hands (0 left, 1 right) towards a target, in place, supported by trunk, knees and gaze. `outward`
    is the target's horizontal angle from straight ahead, `elevation` that above the shoulder, radians; `part`
    its distance in arm lengths; `weight` the progress of the hands (N,), in [0, 1]."""
    turn = sum(LEFT_RIGHT[side] for side in sides)  # a single hand also moves its shoulder
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


def draw_waving(rng: np.random.Generator, t: Array) -> Puppet:
    """Draw a person who waves with one or both hands. Height, rate and width depend on the person."""
    puppet = stand(rng, t, Style.draw(rng))
    sides = ((0,), (1,), (0, 1))[rng.choice(3, p=[0.4, 0.4, 0.2])]
    raised = rng.uniform([0.1, 0.05, 0.12], [0.3, 0.4, 0.25])
    rate, width = rng.uniform(0.9, 2.0), rng.uniform(0.04, 0.1)
    for start, end in draw_occasions(rng, t, (2.5, 6.0), (0.4, 2.0)):
        weight = make_pulse(t, start, start + 0.8, end - 0.8, end)
        beat = 2 * np.pi * rate * (t - start) + 0.5 * make_wander(rng, t)
        puppet.spine[:, 2] += 0.015 * len(sides) * weight * np.sin(beat)
        for side in sides:
            aside = width * np.sin(beat + side * rng.uniform(-0.3, 0.3))
            target = raised + np.stack([aside, -0.3 * np.abs(aside) ** 2 / width, np.zeros_like(t)], -1)
            move_hand(puppet, side, target, weight)
            puppet.wrists[:, side, 2] += 3.0 * aside * weight
    return puppet


def draw_punching(rng: np.random.Generator, t: Array) -> Puppet:
    """Draw combinations of punches from a boxer's stance, with small steps and bounces."""
    style = Style.draw(rng)
    lead = int(rng.integers(2))
    bladed = -LEFT_RIGHT[lead] * rng.uniform(0.3, 0.6)
    stagger = LEFT_RIGHT[lead] * rng.uniform(0.12, 0.2)
    work = Footwork(FootPlacement(style.origin, style.heading, style.width + 0.04, style.splay, stagger))
    for start, _ in draw_occasions(rng, t, (0.8, 1.5), (0.5, 3.0)):
        shift, turn = rng.uniform(-0.2, 0.2, 2), rng.uniform(-0.3, 0.3)
        work.change_stance(start, 0.28, 0.32, shift, turn, first=int(rng.integers(2)), lift=0.03)
    puppet = stand(rng, t, style, work)
    puppet.tilt[:, 1] += bladed
    bend_knees(puppet, 0.06 + 0.012 * np.sin(2 * np.pi * rng.uniform(1.2, 2.0) * t + make_wander(rng, t)))
    for side in (0, 1):
        move_hand(puppet, side, np.array(GUARD[side != lead]), np.ones_like(t))
    blows = _draw_punches(rng, t, lead)
    for side, start, reach, end, kind in blows:
        weight = make_pulse(t, start, reach, reach, end)
        puppet.spine[:, 1] -= LEFT_RIGHT[side] * PUNCHES[kind][1] * 0.6 * weight
        puppet.tilt[:, 1] -= LEFT_RIGHT[side] * PUNCHES[kind][1] * 0.5 * weight
        puppet.feet.heel[:, side] += 0.3 * weight * (side != lead)
    for side, start, reach, end, kind in blows:
        weight = make_pulse(t, start, reach, reach, end)
        move_hand(puppet, side, _convert_to_trunk(puppet, side, PUNCHES[kind][0]), weight)
        puppet.wrists[:, side, 0] += weight
    return puppet


def _draw_punches(
    rng: np.random.Generator, t: Array, lead: int
) -> list[tuple[int, float, float, float, str]]:
    """Draw combinations of punches with alternating hands: side, start, reach and end in seconds,
    and kind."""
    blows = []
    for start, end in draw_occasions(rng, t, (0.7, 2.2), (0.3, 1.5)):
        side, now = lead if rng.random() < 0.7 else 1 - lead, start
        while now < end:
            out, back = rng.uniform(0.18, 0.28), rng.uniform(0.28, 0.4)
            blows.append((side, now, now + out, now + out + back, str(rng.choice(list(PUNCHES)))))
            now, side = now + out + rng.uniform(0.6, 1.1) * back, 1 - side
    return blows


def _convert_to_trunk(puppet: Puppet, side: int, target: Array) -> Array:
    """Convert a hand target (3,) from the heading's frame to the frames of the rotated trunk (N, 3)."""
    yaw = LEFT_RIGHT[side] * (puppet.tilt[:, 1] + puppet.spine[:, 1])
    out, up, forward = target
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return np.stack([out * cosine - forward * sine, np.full_like(yaw, up), forward * cosine + out * sine], -1)


def draw_jumping(rng: np.random.Generator, t: Array) -> Puppet:
    """Draw jumps on the spot, forward, sideways and with a turn."""
    style = Style.draw(rng)
    work = Footwork(FootPlacement(style.origin, style.heading, style.width + 0.02, style.splay))
    height, leaps = rng.uniform(0.1, 0.35), []
    for start, _ in draw_occasions(rng, t, (2.3, 2.6), (0.0, 1.5)):
        rise, off = height * rng.uniform(0.8, 1.1), start + rng.uniform(0.7, 0.9)
        flight = np.sqrt(8 * rise / GRAVITY)
        shift, turn = rng.uniform(-0.3, 0.3, 2) * rng.integers(2), rng.uniform(-0.9, 0.9) * rng.integers(2)
        work.change_stance(off, flight, 0.0, shift, turn, lift=rise + 0.08, heel=0.9, toe=0.0, push=0.2)
        leaps.append((start, off, off + flight, rng.uniform(0.18, 0.3)))
    puppet = stand(rng, t, style, work)
    puppet.settle = 0.03
    for leap in leaps:
        _perform_jump(puppet, t, style.swing, *leap)
    return puppet


def _perform_jump(
    puppet: Puppet, t: Array, swing: float, start: float, off: float, on: float, depth: float
) -> None:
    """Move pelvis, trunk and arms through one jump, in place. `swing` is a factor on the swing of the arms;
    `start` (of the crouch), `off` and `on` (landing) are seconds; `depth` is that of the crouch, metres."""
    low, deep, end, speed = off - 0.28, on + 0.22, on + 0.9, GRAVITY * (on - off) / 2
    heights, speeds = [0, -depth, -0.04, -0.08, -0.7 * depth, 0], [0, 0, speed, -speed, 0, 0]
    inside = (t > start) & (t < end)
    path = CubicHermiteSpline([start, low, off, on, deep, end], heights, speeds)
    puppet.pelvis[inside, 2] += path(t[inside])
    crouch = make_pulse(t, start, low, low, off) + 0.7 * make_pulse(t, on, deep, deep, end)
    puppet.pelvis[:, :2] -= 0.3 * depth * crouch[:, None] * compute_direction(puppet.heading)
    puppet.tilt[:, 0] += 1.8 * depth * crouch
    puppet.spine[:, 0] += 1.0 * depth * crouch
    back, ahead = np.array([0.12, -0.44, -0.25]), np.array([0.1, 0.15 * swing, 0.4])
    for side in (0, 1):
        move_hand(puppet, side, back, swing / 1.5 * make_pulse(t, start, low - 0.05, low, off - 0.02))
        move_hand(puppet, side, ahead, make_pulse(t, low, off + 0.05, off + 0.1, deep + 0.2))


def draw_sidestepping(rng: np.random.Generator, t: Array) -> Puppet:
    """Draw steps to the left and to the right: one foot leads, and the second foot follows."""
    style = Style.draw(rng)
    work = Footwork(FootPlacement(style.origin, style.heading, style.width + 0.02, style.splay))
    pace, tempo = rng.uniform(0.15, 0.38), rng.uniform(0.38, 0.55)
    now, first = rng.uniform(0.2, 1.0), int(rng.integers(2))
    while now < t[-1]:
        for _ in range(rng.integers(2, 6)):
            way = work.stance.heading + LEFT_RIGHT[first] * np.pi / 2 + rng.uniform(-0.3, 0.3)
            shift = pace * rng.uniform(0.85, 1.15) * compute_direction(way)
            turn = rng.uniform(-0.15, 0.15)
            work.change_stance(now, tempo, tempo + 0.06, shift, turn, first, lift=0.05, heel=0.3, push=0.2)
            now += 2 * tempo + 0.15
        now, first = now + rng.uniform(0.2, 1.0), 1 - first
    puppet = stand(rng, t, style, work)
    bend_knees(puppet, np.full_like(t, rng.uniform(0.02, 0.08)))
    puppet.hands[:, :, 0] += rng.uniform(0.0, 0.1)
    puppet.hands[:, :, 1:] += rng.uniform(0.0, 0.15)
    return puppet


def draw_idling(rng: np.random.Generator, t: Array) -> Puppet:
    """Draw a standing person who shifts the weight, looks around, and sometimes turns on the spot."""
    style = Style.draw(rng)
    work = Footwork(FootPlacement(style.origin, style.heading, style.width, style.splay))
    for start, _ in draw_occasions(rng, t, (1.6, 2.0), (2.0, 6.0)):
        turn = rng.uniform(-0.9, 0.9)
        first = int(turn < 0)
        shift = rng.uniform(-0.08, 0.08, 2)
        work.change_stance(start, 0.5, 0.6, shift, turn, first, lift=0.04, heel=0.3, push=0.25)
    puppet = stand(rng, t, style, work)
    sway = 0.04 * make_wander(rng, t, low=0.05, high=0.25)
    puppet.pelvis[:, :2] += sway[:, None] * compute_direction(puppet.heading + np.pi / 2)
    puppet.tilt[:, 2] += 0.8 * sway
    puppet.spine[:, 2] -= 0.8 * sway
    for start, end in draw_occasions(rng, t, (1.5, 4.0), (0.2, 2.0)):
        look = make_pulse(t, start, start + rng.uniform(0.5, 0.7), end - 0.7, end)
        pitch, yaw = rng.uniform([-0.5, -1.2], [0.5, 1.2])
        puppet.gaze += np.outer(look, [pitch, yaw])
        puppet.spine[:, 1] += 0.3 * yaw * look
    return puppet
