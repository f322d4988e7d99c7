"""Converts a recording to a clip on the 22-joint tree, by a skeleton map: stance, rotations, floor, check.

A file's node and its body joint have the same global rotation, up to a constant correction on the right. The
corrections come from one pose, the stance: the person stands in it, so the rotations of the body's joints are
known (`anatomy.orientations`), whatever the file's zero pose is. A zero pose may be a
T-pose, or a pose that no standing person has: bones along one axis, a folded body, a person who lies. Then a
frame of the motion is used, or rotations that the skeleton map gives.

Where an unmapped joint between two mapped ones turns, the correction is not constant: the segment between
them is then turned by the least rotation to its direction in the file. A body joint without a counterpart
takes its parent's rotation.

Up is the direction of the head in the zero pose, if that is a person who stands, also if the person lies in
the motion. If the motion has the head along the other axis, it can mean two things: a person who lies all the
time, or one who walks while only the root's rotation has the other axis up. Then the user has to decide.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from memmlp.common.errors import InputError
from memmlp.motion.body import HEAD, JOINTS, PARENTS
from memmlp.motion.clip import Clip
from memmlp.motion.formats.recording import Recording
from memmlp.motion.geometry import clip_kinematics
from memmlp.motion.importing import anatomy
from memmlp.motion.importing.anatomy import (
    FEET,
    HINGES,
    HIPS,
    LEG_LENGTH,
    LEGS,
    LIMBS,
    Segment,
    least_rotation,
    segments,
)
from memmlp.motion.importing.fidelity import Fidelity, compare
from memmlp.motion.importing.skeleton_map import (
    REQUIRED,
    UPRIGHT,
    Z_UP,
    MappedMotion,
    SkeletonMap,
    pick_joints,
)

AUTO, NONE = "auto", "none"  # options of the floor, beside a height

UNITS = (1.0, 0.1, 0.0254 / 0.45, 0.0254, 0.01, 0.001)  # metres; 0.0254 / 0.45 is CMU's inch
GIVEN_LEG = (0.3, 1.5)  # metres that a given unit may result in: children, giants
UPRIGHT_SHARE = 0.5  # least mean share of the way from pelvis to head along an up axis that is found

POSITION_LIMIT = 1e4  # metres, as in `read_clip`
HIP_LINE = Segment(HIPS[1], HIPS[0])
STRAIGHTEST = "the straightest frame"
TRIED = 500  # frames of a file, evenly spread, among which a stance is looked for

CONTACT = 0.02  # metres: height of the toe joint above the floor it stands on (the built-in body's)
STANDING_SPEED = 0.15  # metres a second: a toe that stands is slower
SECONDS = 0.2  # toes must stand as long in all for a floor to be known
LOWEST = 0.05  # share of the standing toes that may be lower: noise, and feet that sink in

JUMP = 4.0  # first steps from which on frame 0 is a calibration pose
JUMPED = 0.05  # a smaller step, in multiples of the skeleton's size, does not count


@dataclass(frozen=True)
class Conversion:
    """A recording converted to the body.

    Attributes:
        clip: the motion, world (Z up), with its floor at 0 if the floor is known.
        fitted: the constants of the conversion.
        fidelity: the deviation of the clip from the file's motion, and its faults.
        floor: height of the floor in the recording, metres on the body's scale, which was subtracted; None if
            it is unknown or was not asked for.
    """

    clip: Clip
    fitted: Retargeting
    fidelity: Fidelity
    floor: float | None


def convert(
    recording: Recording,
    skeleton: SkeletonMap,
    rest: np.ndarray,
    *,
    name: str,
    fps: float,
    floor: str | float = AUTO,
) -> Conversion:
    """Convert a recording to a body.

    Args:
        recording: the file's motion.
        skeleton: the recording's skeleton map.
        rest: the body's rest joints (22, 3), metres.
        name: the clip's name.
        fps: the true frame rate, Hz.
        floor: `auto`, found from the feet; `none`, left as it is; or the floor's height in the file, metres.

    Raises:
        InputError: as `pick_joints` and `fit` do.
    """
    fitted = fit(recording, skeleton, rest)
    clip = to_body(fitted, rest, name, fps)
    if floor == AUTO:
        height = find_floor(clip_kinematics(clip, rest)[1], clip.fps)
    else:
        height = None if floor == NONE else float(floor) * fitted.scale
    clip = replace(clip, trans=clip.trans - [0.0, 0.0, height or 0.0])
    return Conversion(clip, fitted, compare(clip, fitted.motion, rest, skeleton.name), height)


# Stance and conversion


@dataclass(frozen=True)
class Stance:
    """A stance, turned so that the person faces +Z (Y up, metres).

    Attributes:
        rotations: global rotations (22, 3, 3) of the mapped joints' nodes.
        positions: their positions (22, 3).
        nodes: positions (nodes, 3) of all of the file's nodes.
        source: a description of the file's pose.
        straight: whether the limbs are as in the zero pose, and so assumed to have no twist.
    """

    rotations: np.ndarray
    positions: np.ndarray
    nodes: np.ndarray
    source: str
    straight: bool


@dataclass(frozen=True)
class Retargeting:
    """The motion of a recording's mapped joints, and the constants that convert it to a body.

    Attributes:
        skeleton: the recording's skeleton map, with unit and up axis filled in.
        motion: the mapped joints' motion.
        stance: the pose from which the corrections follow.
        corrections: (22, 3, 3), on the right of the rotations of the mapped nodes, in Y-up axes.
        scale: the body's leg length divided by the recording's.
    """

    skeleton: SkeletonMap
    motion: MappedMotion
    stance: Stance
    corrections: np.ndarray
    scale: float


def find_stance(recording: Recording, skeleton: SkeletonMap, motion: MappedMotion) -> Stance:
    """Find the stance of a file: the map's, else the zero pose, else the straightest frame.

    Raises:
        InputError: if there is no such pose, or its left and right contradict each other.
    """
    upright, positions, path = skeleton.upright, motion.positions, recording.path

    def stance(rotations: np.ndarray, pose: np.ndarray, nodes: np.ndarray, source: str) -> Stance:
        if (why := anatomy.wrong_sides(pose, motion.mapped)) is not None:
            raise InputError(f"{path}: in {source}, {why}; check left and right in the map, and the up axis")
        turn = anatomy.facing(pose)
        nodes = skeleton.unit * nodes @ upright.T @ turn.T
        straight = np.allclose(rotations[[*LIMBS]], np.eye(3))
        return Stance(turn @ rotations, pose @ turn.T, nodes, source, straight)

    if skeleton.rest is not None:
        rotations, nodes = recording.pose(skeleton.rest)
        pose = skeleton.unit * nodes[motion.nodes] @ upright.T
        if (why := anatomy.why_no_stance(pose)) is not None:
            raise InputError(f"{path}: rest of skeleton {skeleton.name}: {why}; must be an upright stance")
        return stance(upright @ rotations[motion.nodes] @ upright.T, pose, nodes, "the map's rest pose")
    why = anatomy.why_no_stance(motion.zero)
    if why is None:
        eyes = np.tile(np.eye(3), (len(motion.zero), 1, 1))
        zero = stance(eyes, motion.zero, recording.zero_pose(), "the zero pose")
        if not anatomy.arms_lifted(zero.positions):
            return zero
        why = "an arm is more than 100 degrees from a T-pose's"
    frames = np.unique(np.linspace(0, len(motion) - 1, TRIED).astype(int))
    order = frames[np.argsort(anatomy.unevenness(positions[frames]), kind="stable")]
    standing = [int(frame) for frame in order if anatomy.why_no_stance(positions[frame]) is None]
    if not standing:
        best = anatomy.why_no_stance(positions[order[0]])
        raise InputError(
            f"{path}: the person stands neither in the zero pose ({why}) nor in any frame (at best, {best}); "
            "check up and joints in the map, or give it a rest"
        )
    sound = (frame for frame in standing if anatomy.wrong_sides(positions[frame], motion.mapped) is None)
    frame = next(sound, standing[0])
    nodes = recording.kinematics()[1][frame + int(skeleton.calibration_frame)]
    return stance(motion.rotations[frame], positions[frame], nodes, f"{STRAIGHTEST} {frame}")


def fit(recording: Recording, skeleton: SkeletonMap, rest: np.ndarray) -> Retargeting:
    """Fit a recording's skeleton to a body's rest joints (22, 3), metres.

    Raises:
        InputError: if the file shows no unit, up axis or standing person, or left and right contradict each
            other.
    """
    skeleton = find_unit_and_up(recording, skeleton)
    motion = pick_joints(recording, skeleton)
    stance = find_stance(recording, skeleton, motion)
    turned = anatomy.orientations(stance.positions, motion.mapped, rest)
    if not stance.straight:
        _turn_to_hinges(turned, stance, motion, rest)
    corrections = stance.rotations.swapaxes(-1, -2) @ turned
    scale = float(_leg_length(rest) / np.median(_leg_length(motion.positions)))
    return Retargeting(skeleton, motion, stance, corrections, scale)


def to_body(fitted: Retargeting, rest: np.ndarray, name: str, fps: float) -> Clip:
    """Return mapped motion as a clip on the body that it was fitted to, in the world (Z up).

    The middle of the hips is at its place in the recording, scaled by the ratio of leg lengths.

    Args:
        fitted: the result of `fit`.
        rest: the body's rest joints (22, 3), metres.
        name: the clip's name.
        fps: the true frame rate, Hz.

    Raises:
        InputError: if the person is more than 10 km from the origin.
    """
    motion = fitted.motion
    turned = Z_UP @ _aim_segments(motion, motion.rotations @ fitted.corrections, rest)
    hips = fitted.scale * motion.positions[:, list(HIPS)].mean(1) @ Z_UP.T
    trans = hips - turned[:, 0] @ (rest[list(HIPS)].mean(0) - rest[0]) - rest[0]
    if np.abs(trans).max() > POSITION_LIMIT:
        far = f"{np.abs(trans).max():.3g} m from the origin"
        raise InputError(f"{motion.path}: {far}; must be within {POSITION_LIMIT:g} m")
    local = turned.copy()
    local[:, 1:] = turned[:, list(PARENTS[1:])].swapaxes(-1, -2) @ turned[:, 1:]
    poses = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(len(local), len(JOINTS), 3)
    return Clip(name, poses, trans, fps)


def _aim_segments(motion: MappedMotion, turned: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Turn rotations (N, 22, 3, 3), in place, so that their segments point as in the recording."""
    for start, end in (HIP_LINE, *segments(motion.mapped)):
        joint = 0 if (start, end) == HIP_LINE else start
        if joint > 0 or (start, end) == HIP_LINE:
            there = motion.positions[:, end] - motion.positions[:, start]
            bone = turned[:, joint] @ (rest[end] - rest[start])
            turned[:, joint] = least_rotation(bone, there) @ turned[:, joint]
    for joint in map(int, np.flatnonzero(~motion.mapped)):
        turned[:, joint] = turned[:, PARENTS[joint]]
    return turned


def _turn_to_hinges(turned: np.ndarray, stance: Stance, motion: MappedMotion, rest: np.ndarray) -> None:
    """Turn thighs and upper arms about themselves, in place, so that knees and elbows bend about their axes.

    The axes are found from the stance if the limb is bent in it, otherwise from the motion.
    """
    for joint, rest_axis in HINGES.items():
        axis = anatomy.bend(stance.positions, joint)
        if axis is None:
            own = anatomy.hinge(motion.rotations[:, joint], motion.positions, joint)
            axis = None if own is None else stance.rotations[joint] @ own
        if axis is None:
            continue
        middle, end = LIMBS[joint], LIMBS[LIMBS[joint]]
        along = turned[joint] @ (rest[middle] - rest[joint])
        turned[joint] = (
            anatomy.align((along, along), (turned[joint] @ np.array(rest_axis), axis)) @ turned[joint]
        )
        lower = turned[joint] @ (rest[end] - rest[middle])
        there = stance.positions[end] - stance.positions[middle]
        turned[middle] = least_rotation(lower, there) @ turned[joint]
        if end in (20, 21):
            turned[end] = turned[middle]


def _leg_length(positions: np.ndarray) -> np.ndarray:
    """Return the lengths (...) of thigh plus shin in positions (..., 22, 3), averaged over both sides."""
    bones = [positions[..., end, :] - positions[..., start, :] for start, end in LEGS.items()]
    return np.linalg.norm(bones, axis=-1).sum(0) / 2


@dataclass(frozen=True)
class StanceView:
    """The stance of a skeleton with all nodes: facing +Z, Y up, left on +X, in metres.

    Attributes:
        nodes: the nodes' names; parents: the index of each node's parent, -1 for the root.
        positions: the nodes' positions (nodes, 3).
        mapped: body joint -> index of its node.
        body: the body's joints (22, 3) in the same stance, the pelvis at the origin.
        source: a description of the file's pose.
    """

    nodes: tuple[str, ...]
    parents: tuple[int, ...]
    positions: np.ndarray
    mapped: dict[str, int]
    body: np.ndarray
    source: str


def view_stance(recording: Recording, skeleton: SkeletonMap, rest: np.ndarray) -> StanceView:
    """Return the stance that an import uses for a file's skeleton, and the body in it.

    Args:
        recording: the file's motion.
        skeleton: the file's skeleton map, with the nodes spelt as in the file.
        rest: the body's rest joints (22, 3), metres.

    Raises:
        InputError: as `convert` does.
    """
    fitted = fit(recording, skeleton, rest)
    stance = fitted.stance
    rotations, body = stance.rotations @ fitted.corrections, np.zeros_like(rest)
    for joint, parent in enumerate(PARENTS[1:], start=1):
        body[joint] = body[parent] + rotations[parent] @ (rest[joint] - rest[parent])
    mapped = {joint: int(fitted.motion.nodes[JOINTS.index(joint)]) for joint in skeleton.joints}
    return StanceView(recording.nodes, recording.node_parents, stance.nodes, mapped, body, stance.source)


# Unit and up axis


def find_unit_and_up(recording: Recording, skeleton: SkeletonMap) -> SkeletonMap:
    """Return the map with unit and up axis filled in from the recording, where the map lacks them.

    Raises:
        InputError: if they can't be found, or if a given unit makes the legs too short or long for a person.
    """
    nodes = {
        joint: recording.nodes.index(node)
        for joint, node in skeleton.joints.items()
        if node in recording.nodes
    }
    positions = recording.kinematics()[1][int(skeleton.calibration_frame) :]
    if not {JOINTS[joint] for joint in (0, HEAD, *LEGS, *LEGS.values())} <= set(nodes) or not len(positions):
        return skeleton  # `pick_joints` reports it
    bones = [
        positions[:, nodes[JOINTS[end]]] - positions[:, nodes[JOINTS[start]]] for start, end in LEGS.items()
    ]
    leg = float(sum(np.linalg.norm(bone, axis=-1).mean() for bone in bones) / 2)
    trunk = positions[:, nodes["head"]] - positions[:, nodes["pelvis"]]
    return replace(
        skeleton,
        up=skeleton.up or _find_up(recording, trunk, nodes),
        unit=_find_unit(recording, skeleton, leg),
    )


def _find_unit(recording: Recording, skeleton: SkeletonMap, leg: float) -> float:
    """Return the unit, metres, of a file with legs of the given length."""
    if skeleton.unit is not None:
        low, high = GIVEN_LEG
        if not low <= leg * skeleton.unit <= high:
            raise InputError(
                f"{recording.path}: unit={skeleton.unit:g} of {skeleton.name} makes the legs "
                f"{leg * skeleton.unit:.3g} m long; must give {low:g} to {high:g} m"
            )
        return skeleton.unit
    fitting = [unit for unit in UNITS if LEG_LENGTH[0] <= leg * unit <= LEG_LENGTH[1]]
    if not fitting:
        raise InputError(
            f"{recording.path}: the legs are {leg:.3g} long in the file's unit, which is not one of "
            f"{', '.join(f'{unit:.4g}' for unit in UNITS)} m; give the unit in the skeleton's map"
        )
    return min(fitting, key=lambda unit: abs(leg * unit - 0.85))


def _find_up(recording: Recording, trunk: np.ndarray, nodes: dict[str, int]) -> str:
    """Return the axis, `y` or `z`, that is up in a file, from the vectors from pelvis to head (N, 3)."""
    mean = (trunk / np.linalg.norm(trunk, axis=-1, keepdims=True).clip(1e-9)).mean(0)
    along = {"y": float(mean[1]), "z": float(mean[2])}
    moving = max(along, key=lambda axis: along[axis])
    standing = None
    if set(REQUIRED) <= set(nodes):
        zero, pose = recording.zero_pose(), np.zeros((len(JOINTS), 3))
        for joint, node in nodes.items():
            pose[JOINTS.index(joint)] = zero[node]
        standing = next(
            (a for a, turn in UPRIGHT.items() if anatomy.why_no_stance(pose @ turn.T) is None), None
        )
    upright = along[moving] >= UPRIGHT_SHARE
    if upright and standing in (None, moving):
        return moving
    advice = "give --up y or z, or up in the skeleton's map"
    if standing is None or along[standing] <= -UPRIGHT_SHARE:
        x, y, z = mean
        raise InputError(
            f"{recording.path}: no up axis found, as the head is along ({x:.2f}, {y:.2f}, {z:.2f}) from the "
            f"pelvis on average; {advice}"
        )
    if upright:
        raise InputError(
            f"{recording.path}: the person stands along {standing} in the zero pose, but along {moving} in "
            f"the motion; {advice}: --up {standing} if the person lies, else --up {moving}"
        )
    return standing


# Floor and calibration frame


def find_floor(positions: np.ndarray, fps: float) -> float | None:
    """Return the height of the floor, metres.

    It is below nearly all toes that stand still, and not above the lowest joint in nearly all frames.

    Args:
        positions: global joint positions (N, 22, 3), world (Z up).
        fps: frames per second.

    Returns:
        None if no toe stands long enough to show the floor's height.
    """
    toes = positions[:, list(FEET.values())]
    if len(toes) < 2:
        return None
    speed = np.linalg.norm(np.gradient(toes, axis=0), axis=-1) * fps
    standing = toes[..., 2][speed < STANDING_SPEED]
    if len(standing) < SECONDS * fps:
        return None
    lowest = np.quantile(positions[..., 2].min(1), LOWEST)  # for people who lie, with their toes up
    return float(min(np.quantile(standing, LOWEST) - CONTACT, lowest))


def first_step(recording: Recording) -> float:
    """Return the step from frame 0 to frame 1, divided by the 90 % quantile of all later steps.

    A step is the largest distance that a node moves relative to the root. The result is 0 for a short
    recording, or if the first step is small compared with the body. Beyond `JUMP`, frame 0 is a calibration
    pose, such as a T-pose, and not motion.
    """
    if len(recording) < 4:
        return 0.0
    positions = recording.kinematics()[1]
    pose = positions - positions[:, :1]
    steps = np.linalg.norm(np.diff(pose, axis=0), axis=-1).max(-1)
    if steps[0] <= JUMPED * np.linalg.norm(pose[0], axis=-1).max():
        return 0.0
    return float(steps[0] / max(np.quantile(steps[1:], 0.9), 1e-9))
