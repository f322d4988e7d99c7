"""Converts a recording to a clip with 22 joints, by a skeleton map.

A body joint has the global rotation of its node in the file, times a constant correction on the right. The
corrections come from one pose, the stance, in which the person stands upright and the rotations of the body
joints can be computed (`anatomy.compute_orientations`). The stance is the file's zero pose if a person stands
in it, else a frame of the motion, or a pose in the skeleton map.

The correction is not constant if an unmapped joint between two mapped joints turns. So each segment is also
turned to its direction in the file, by the smallest rotation. A body joint without a node has its parent's
rotation.

If a person stands in the zero pose, the head is up in this pose. If the head is along a different axis in the
motion, the person may lie all the time, or the root's rotation has a different up axis than the zero pose.
Then the user has to decide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from memmlp.common.errors import InputError
from memmlp.motion.body import HEAD, JOINTS, PARENTS
from memmlp.motion.clip import Clip
from memmlp.motion.formats.npz import FARTHEST
from memmlp.motion.formats.recording import Recording
from memmlp.motion.geometry import compute_clip_kinematics
from memmlp.motion.importing import anatomy
from memmlp.motion.importing.anatomy import (
    FEET,
    HINGES,
    HIPS,
    LEG_LENGTH,
    LEGS,
    LIMBS,
    Segment,
    compute_least_rotation,
    list_segments,
)
from memmlp.motion.importing.fidelity import Fidelity, compare_with_recording
from memmlp.motion.importing.skeleton_map import (
    REQUIRED,
    UPRIGHT,
    Z_UP,
    MappedMotion,
    SkeletonMap,
    pick_joints,
)

AUTO, NONE = "auto", "none"  # options for the floor, besides a height

UNITS = (1.0, 0.1, 0.0254 / 0.45, 0.0254, 0.01, 0.001)  # metres; 0.0254 / 0.45 is CMU's inch
GIVEN_LEG = (0.3, 1.5)  # metres: range of leg lengths with a given unit, from children to giants
UPRIGHT_SHARE = 0.5  # minimum mean component of the direction from pelvis to head along the up axis

HIP_LINE = Segment(HIPS[1], HIPS[0])
STRAIGHTEST = "the straightest frame"
TWIST = 1.0  # degrees: maximum twist of a limb that counts as untwisted
TRIED = 500  # maximum number of evenly spaced frames in the search for a stance

CONTACT = 0.02  # metres: height of a standing toe joint above the floor, on the built-in body
STANDING_SPEED = 0.15  # m/s: maximum speed of a standing toe
SECONDS = 0.2  # minimum total time of standing toes that shows the floor
LOWEST = 0.05  # fraction of standing toes that may be below the floor, because of noise

JUMP = 4.0  # minimum first step (`measure_first_step`) of a calibration pose in frame 0
JUMPED = 0.05  # multiples of the skeleton's size: smaller first steps are ignored


@dataclass(frozen=True)
class Conversion:
    """A recording converted to the body. The clip is in the world (Z up), with a known floor at height 0;
    `floor` is the subtracted height, metres at the body's scale, or None."""

    clip: Clip
    fitted: Retargeting
    fidelity: Fidelity
    floor: float | None


def convert_recording(
    recording: Recording,
    skeleton: SkeletonMap,
    rest: np.ndarray,
    *,
    name: str,
    fps: float,
    floor: str | float = AUTO,
) -> Conversion:
    """Convert a recording to a clip of the true rate `fps`, Hz, on a body with rest joints (22, 3), metres.
    `floor` is `auto`: find it from the feet; `none`: keep all heights; or its height in the file, metres.
    Raises InputError for the reasons in `pick_joints` and `fit_skeleton`."""
    fitted = fit_skeleton(recording, skeleton, rest)
    clip = convert_to_body(fitted, rest, name, fps)
    if floor == AUTO:
        height = find_floor(compute_clip_kinematics(clip, rest)[1], clip.fps)
    else:
        height = None if floor == NONE else float(floor) * fitted.scale
    clip = replace(clip, trans=clip.trans - [0.0, 0.0, height or 0.0])
    return Conversion(clip, fitted, compare_with_recording(clip, fitted.motion, rest, skeleton.name), height)


# Stance and conversion


@dataclass(frozen=True)
class Stance:
    """A stance in which the person faces +Z (Y up, metres). `untwisted` are the hips and shoulders (`HINGES`)
    of limbs that do not turn about their bones from a zero pose that stands, and so are assumed to be without
    twist."""

    rotations: np.ndarray  # global rotations (22, 3, 3) of the mapped joints' nodes
    positions: np.ndarray  # positions (22, 3) of the mapped joints' nodes
    nodes: np.ndarray  # positions (nodes, 3) of all nodes in the file
    source: str  # a description of the pose in the file
    untwisted: frozenset[int]


@dataclass(frozen=True)
class Retargeting:
    """The motion of a recording's mapped joints, and the constants that convert it to a body."""

    skeleton: SkeletonMap  # with a known unit and up axis
    motion: MappedMotion
    stance: Stance  # the pose that determines the corrections
    corrections: np.ndarray  # rotations (22, 3, 3), on the right of the nodes' rotations, in Y-up axes
    scale: float  # the body's leg length divided by the recording's


def find_stance(recording: Recording, skeleton: SkeletonMap, motion: MappedMotion) -> Stance:
    """Find the stance of a file: the rest pose in the map, else the zero pose, else the straightest frame.
    Raises InputError if the file has no such pose, or if left and right contradict each other."""
    upright, positions, path = skeleton.upright_rotation, motion.positions, recording.path
    stands = (why := anatomy.find_stance_fault(motion.zero)) is None

    def stance(rotations: np.ndarray, pose: np.ndarray, nodes: np.ndarray, source: str) -> Stance:
        if (fault := anatomy.find_side_fault(pose, motion.mapped)) is not None:
            raise InputError(f"{path}: in {source}, {fault}; check left and right in the map and the up axis")
        turn = anatomy.find_facing_turn(pose)
        nodes = skeleton.unit * nodes @ upright.T @ turn.T
        untwisted = frozenset(j for j in HINGES if stands and _is_untwisted(j, rotations, motion.zero))
        return Stance(turn @ rotations, pose @ turn.T, nodes, source, untwisted)

    if skeleton.rest is not None:
        source = f"frame {skeleton.rest}" if isinstance(skeleton.rest, int) else "the map's rest pose"
        rotations, nodes = _compute_rest(recording, skeleton.rest)
        pose = skeleton.unit * nodes[motion.nodes] @ upright.T
        if (fault := anatomy.find_stance_fault(pose)) is not None:
            where = f"rest in skeleton {skeleton.name} ({source})"
            raise InputError(f"{path}: {where} must be an upright stance, but {fault}")
        return stance(upright @ rotations[motion.nodes] @ upright.T, pose, nodes, source)
    if stands:
        identities = np.tile(np.eye(3), (len(motion.zero), 1, 1))
        zero = stance(identities, motion.zero, recording.compute_zero_pose(), "the zero pose")
        if not anatomy.has_raised_arm(zero.positions):
            return zero
        why = "an arm points more than 100 degrees away from its T-pose direction"
    frames = np.unique(np.linspace(0, len(motion) - 1, TRIED).astype(int))
    order = frames[np.argsort(anatomy.measure_unevenness(positions[frames]), kind="stable")]
    standing = [int(frame) for frame in order if anatomy.find_stance_fault(positions[frame]) is None]
    if not standing:
        best = anatomy.find_stance_fault(positions[order[0]])
        wrong = f"the person stands neither in the zero pose ({why}) nor in a frame (best: {best})"
        advice = "check the keys up: and joints: of the map, or add its key rest:"
        raise InputError(f"{path}: {wrong}; {advice}")
    sound = (frame for frame in standing if anatomy.find_side_fault(positions[frame], motion.mapped) is None)
    frame = next(sound, standing[0])
    nodes = recording.compute_kinematics()[1][frame + int(skeleton.calibration_frame)]
    return stance(motion.rotations[frame], positions[frame], nodes, f"{STRAIGHTEST} {frame}")


def _is_untwisted(joint: int, rotations: np.ndarray, zero: np.ndarray) -> bool:
    """Return whether neither bone of a limb is turned about its own direction, relative to the zero pose."""
    middle, end = LIMBS[joint], LIMBS[LIMBS[joint]]
    bones = anatomy.normalize_vectors(np.diff(zero[[joint, middle, end]], axis=0))
    turns = [rotations[joint], rotations[joint].T @ rotations[middle]]
    twists = (Rotation.from_matrix(np.array(turns)).as_rotvec() * bones).sum(-1)
    return bool(np.abs(np.degrees(twists)).max() < TWIST)


def _compute_rest(
    recording: Recording, rest: Mapping[str, Sequence[float]] | int
) -> tuple[np.ndarray, np.ndarray]:
    if not isinstance(rest, int):
        return recording.compute_pose(rest)
    if rest >= len(recording):
        allowed = f"one of frames 0 to {len(recording) - 1}"
        raise InputError(f"{recording.path}: rest: frame {rest}: must be {allowed}")
    rotations, positions = recording.compute_kinematics()
    return rotations[rest], positions[rest] - positions[rest, 0]


def fit_skeleton(recording: Recording, skeleton: SkeletonMap, rest: np.ndarray) -> Retargeting:
    """Fit a recording's skeleton to a body's rest joints (22, 3), metres. Raises InputError if the unit, the
    up axis or a stance cannot be found, or if left and right contradict each other."""
    skeleton = find_unit_and_up(recording, skeleton)
    motion = pick_joints(recording, skeleton)
    stance = find_stance(recording, skeleton, motion)
    turned = anatomy.compute_orientations(stance.positions, motion.mapped, rest)
    _align_bend_axes(turned, stance, motion, rest)
    corrections = stance.rotations.swapaxes(-1, -2) @ turned
    scale = float(_measure_legs(rest) / np.median(_measure_legs(motion.positions)))
    return Retargeting(skeleton, motion, stance, corrections, scale)


def convert_to_body(fitted: Retargeting, rest: np.ndarray, name: str, fps: float) -> Clip:
    """Convert mapped motion, fitted to this body with rest joints (22, 3), metres, to a clip in the world (Z
    up) at a rate in Hz. The midpoint of the hips has its position in the recording, scaled by the ratio of
    leg lengths. Raises InputError if the person is farther than 10 km from the origin."""
    motion = fitted.motion
    turned = Z_UP @ _aim_segments(motion, motion.rotations @ fitted.corrections, rest)
    hips = fitted.scale * motion.positions[:, list(HIPS)].mean(1) @ Z_UP.T
    trans = hips - turned[:, 0] @ (rest[list(HIPS)].mean(0) - rest[0]) - rest[0]
    if np.abs(trans).max() > FARTHEST:
        far = f"the person is {np.abs(trans).max():.3g} m from the origin"
        raise InputError(f"{motion.path}: {far}; must be within {FARTHEST:g} m")
    local = turned.copy()
    local[:, 1:] = turned[:, list(PARENTS[1:])].swapaxes(-1, -2) @ turned[:, 1:]
    poses = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(len(local), len(JOINTS), 3)
    return Clip(name, poses, trans, fps)


def _aim_segments(motion: MappedMotion, turned: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Turn rotations (N, 22, 3, 3) in place until all segments have their directions in the recording."""
    segments = [(0, HIP_LINE), *((one.start, one) for one in list_segments(motion.mapped) if one.start > 0)]
    for joint, (start, end) in segments:
        there = motion.positions[:, end] - motion.positions[:, start]
        bone = turned[:, joint] @ (rest[end] - rest[start])
        turned[:, joint] = compute_least_rotation(bone, there) @ turned[:, joint]
    for joint in map(int, np.flatnonzero(~motion.mapped)):
        turned[:, joint] = turned[:, PARENTS[joint]]
    return turned


def _align_bend_axes(rotations: np.ndarray, stance: Stance, motion: MappedMotion, rest: np.ndarray) -> None:
    """Twist thighs and upper arms in place until the knees' and elbows' bending axes fit the recording: in
    the stance if the limb is bent there, otherwise in the motion."""
    for joint, rest_axis in HINGES.items():
        if joint in stance.untwisted:
            continue
        axis = anatomy.find_bend_axis(stance.positions, joint)
        if axis is None:
            local_axis = anatomy.find_hinge_axis(motion.rotations[:, joint], motion.positions, joint)
            axis = None if local_axis is None else stance.rotations[joint] @ local_axis
        if axis is None:
            continue
        middle, end = LIMBS[joint], LIMBS[LIMBS[joint]]
        along = rotations[joint] @ (rest[middle] - rest[joint])
        twist = anatomy.align_directions((along, along), (rotations[joint] @ np.array(rest_axis), axis))
        rotations[joint] = twist @ rotations[joint]
        lower = rotations[joint] @ (rest[end] - rest[middle])
        there = stance.positions[end] - stance.positions[middle]
        rotations[middle] = compute_least_rotation(lower, there) @ rotations[joint]
        if end in (20, 21):
            rotations[end] = rotations[middle]


def _measure_legs(positions: np.ndarray) -> np.ndarray:
    """Measure the lengths (...) of thigh plus shin in positions (..., 22, 3), averaged over both sides."""
    bones = [positions[..., end, :] - positions[..., start, :] for start, end in LEGS.items()]
    return np.linalg.norm(bones, axis=-1).sum(0) / 2


@dataclass(frozen=True)
class StanceView:
    """The stance of a skeleton with all nodes, in metres: Y up, facing +Z, left on +X. `mapped` is body joint
    -> index of its node; `body` has the joint positions (22, 3) of the body in the same stance, with the
    pelvis at the origin."""

    nodes: tuple[str, ...]
    parents: tuple[int, ...]
    positions: np.ndarray
    mapped: dict[str, int]
    body: np.ndarray
    source: str


def view_stance(recording: Recording, skeleton: SkeletonMap, rest: np.ndarray) -> StanceView:
    """Return the stance that an import uses for a file's skeleton, and the body with rest joints (22, 3),
    metres, in this stance. Raises InputError for the reasons in `convert_recording`."""
    fitted = fit_skeleton(recording, skeleton, rest)
    stance = fitted.stance
    rotations, body = stance.rotations @ fitted.corrections, np.zeros_like(rest)
    for joint, parent in enumerate(PARENTS[1:], start=1):
        body[joint] = body[parent] + rotations[parent] @ (rest[joint] - rest[parent])
    mapped = {joint: int(fitted.motion.nodes[JOINTS.index(joint)]) for joint in skeleton.joints}
    return StanceView(recording.nodes, recording.node_parents, stance.nodes, mapped, body, stance.source)


# Unit and up axis


def find_unit_and_up(recording: Recording, skeleton: SkeletonMap) -> SkeletonMap:
    """Return a copy of the map in which a missing unit or up axis is found from the recording. Raises
    InputError if they can't be found, or if the map's unit gives implausible leg lengths."""
    known = {joint: node for joint, node in skeleton.joints.items() if node in recording.nodes}
    nodes = {joint: recording.nodes.index(node) for joint, node in known.items()}
    positions = recording.compute_kinematics()[1][int(skeleton.calibration_frame) :]
    if not {JOINTS[joint] for joint in (0, HEAD, *LEGS, *LEGS.values())} <= set(nodes) or not len(positions):
        return skeleton  # `pick_joints` reports missing nodes
    ends = [(nodes[JOINTS[start]], nodes[JOINTS[end]]) for start, end in LEGS.items()]
    bones = [positions[:, end] - positions[:, start] for start, end in ends]
    leg = float(sum(np.linalg.norm(bone, axis=-1).mean() for bone in bones) / 2)
    trunk = positions[:, nodes["head"]] - positions[:, nodes["pelvis"]]
    up = skeleton.up or _find_up(recording, trunk, nodes)
    return replace(skeleton, up=up, unit=_find_unit(recording, skeleton, leg))


def _find_unit(recording: Recording, skeleton: SkeletonMap, leg: float) -> float:
    """Return the file's unit in metres, given the length of the legs in the file's unit."""
    if skeleton.unit is not None:
        (low, high), metres = GIVEN_LEG, leg * skeleton.unit
        if not low <= metres <= high:
            given = f"with unit={skeleton.unit:g} in skeleton {skeleton.name}"
            wrong = f"the legs are {metres:.3g} m long; must be {low:g} to {high:g} m"
            raise InputError(f"{recording.path}: {given}, {wrong}")
        return skeleton.unit
    fitting = [unit for unit in UNITS if LEG_LENGTH[0] <= leg * unit <= LEG_LENGTH[1]]
    if not fitting:
        wrong = f"{recording.path}: no unit found, because the legs are {leg:.3g} units long"
        tried = ", ".join(f"{unit:.4g}" for unit in UNITS)
        raise InputError(f"{wrong}; set unit in the skeleton map (tried {tried} m)")
    return min(fitting, key=lambda unit: abs(leg * unit - 0.85))


def _find_up(recording: Recording, trunk: np.ndarray, nodes: dict[str, int]) -> str:
    """Find the up axis of a file, `y` or `z`, given vectors from pelvis to head (N, 3) and body joint ->
    index of its node."""
    mean = (trunk / np.linalg.norm(trunk, axis=-1, keepdims=True).clip(1e-9)).mean(0)
    along = {"y": float(mean[1]), "z": float(mean[2])}
    moving = max(along, key=lambda axis: along[axis])
    standing = None
    if set(REQUIRED) <= set(nodes):
        zero, pose = recording.compute_zero_pose(), np.zeros((len(JOINTS), 3))
        for joint, node in nodes.items():
            pose[JOINTS.index(joint)] = zero[node]
        stances = (axis for axis, turn in UPRIGHT.items() if not anatomy.find_stance_fault(pose @ turn.T))
        standing = next(stances, None)
    upright = along[moving] >= UPRIGHT_SHARE
    if upright and standing in (None, moving):
        return moving
    advice = "set --up y or --up z, or up in the skeleton map"
    if standing is None or along[standing] <= -UPRIGHT_SHARE:
        direction = ", ".join(f"{part:.2f}" for part in mean)
        wrong = f"no up axis found, because the mean direction from pelvis to head is ({direction})"
        raise InputError(f"{recording.path}: {wrong}; {advice}")
    if upright:
        raise InputError(
            f"{recording.path}: the person stands along {standing} in the zero pose, but along {moving} in "
            f"the motion; set --up {standing} if the person lies in the motion, otherwise --up {moving}"
        )
    return standing


# Floor and calibration frame


def find_floor(positions: np.ndarray, fps: float) -> float | None:
    """Find the height of the floor, metres, from joint positions (N, 22, 3), world (Z up): below nearly all
    standing toes, and in nearly all frames not above the lowest joint. None if no toe stands still for long
    enough."""
    toes = positions[:, list(FEET.values())]
    if len(toes) < 2:
        return None
    speed = np.linalg.norm(np.gradient(toes, axis=0), axis=-1) * fps
    standing = toes[..., 2][speed < STANDING_SPEED]
    if len(standing) < SECONDS * fps:
        return None
    lowest = np.quantile(positions[..., 2].min(1), LOWEST)  # for people who lie with raised toes
    return float(min(np.quantile(standing, LOWEST) - CONTACT, lowest))


def measure_first_step(recording: Recording) -> float:
    """Measure the step from frame 0 to frame 1, relative to the 90 % quantile of all later steps. A step is
    the maximum distance that a node moves relative to the root. The result is 0 for a short recording or a
    small step. Above `JUMP`, frame 0 is a calibration pose, such as a T-pose."""
    if len(recording) < 4:
        return 0.0
    positions = recording.compute_kinematics()[1]
    pose = positions - positions[:, :1]
    steps = np.linalg.norm(np.diff(pose, axis=0), axis=-1).max(-1)
    if steps[0] <= JUMPED * np.linalg.norm(pose[0], axis=-1).max():
        return 0.0
    return float(steps[0] / max(np.quantile(steps[1:], 0.9), 1e-9))
