"""Converts a recording to a clip on the body: unit and axes, stance, rotations, floor, check.

Up is the direction of the head in the zero pose, if that is a person who stands, also if the person lies in
the motion. If the motion has the head along the other axis, it can mean two things: a person who lies all the
time, or one who walks while only the root's rotation has the other axis up. Then the user has to decide.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from memmlp.common.errors import InputError
from memmlp.motion.body import HEAD, JOINTS, PARENTS
from memmlp.motion.clip import Clip
from memmlp.motion.formats.recording import Recording
from memmlp.motion.geometry import clip_kinematics
from memmlp.motion.importing.anatomy import FEET, LEG_LENGTH, LEGS, why_no_stance
from memmlp.motion.importing.fidelity import Fidelity, compare
from memmlp.motion.importing.retarget import fit, to_body
from memmlp.motion.importing.skeleton_map import REQUIRED, UPRIGHT, MappedMotion, SkeletonMap, pick_joints

AUTO, NONE = "auto", "none"  # options of the floor, beside a height

UNITS = (1.0, 0.1, 0.0254 / 0.45, 0.0254, 0.01, 0.001)  # metres; 0.0254 / 0.45 is CMU's inch
GIVEN_LEG = (0.3, 1.5)  # metres that a given unit may result in: children, giants
UPRIGHT_SHARE = 0.5  # least mean share of the way from pelvis to head along an up axis that is found

CONTACT = 0.02  # metres: height of the toe joint above the floor it stands on (the built-in body's)
STANDING_SPEED = 0.15  # metres a second: a toe that stands is slower
SECONDS = 0.2  # toes must stand as long in all for a floor to be known
LOWEST = 0.05  # share of the standing toes that may be lower: noise, and feet that sink in

JUMP = 4.0  # first steps from which on frame 0 is a calibration pose
JUMPED = 0.05  # a smaller step, in multiples of the skeleton's size, does not count


@dataclass(frozen=True)
class Converted:
    """A recording converted to the body.

    Attributes:
        clip: the motion, world (Z up), with its floor at 0 if the floor is known.
        motion: the mapped joints' motion from which the clip was made.
        fidelity: the deviation of the clip from that motion, and its faults.
        floor: height of the floor in the recording, metres on the body's scale, which was subtracted; None if
            it is unknown or was not asked for.
        scale: the body's size, as a multiple of the recording's.
        stance: a description of the pose from which the skeleton was read.
        unit: the file's unit, metres, given or found.
        up: the file's up axis, given or found.
    """

    clip: Clip
    motion: MappedMotion
    fidelity: Fidelity
    floor: float | None
    scale: float
    stance: str
    unit: float
    up: str


def convert(
    recording: Recording,
    skeleton: SkeletonMap,
    rest: np.ndarray,
    *,
    name: str,
    fps: float | None = None,
    floor: str | float = AUTO,
) -> Converted:
    """Convert a recording to a body.

    Args:
        recording: the file's motion.
        skeleton: the recording's skeleton map.
        rest: the body's rest joints (22, 3), metres.
        name: the clip's name.
        fps: the true frame rate, Hz; by default the file's.
        floor: `auto`, found from the feet; `none`, left as it is; or the floor's height in the file, metres.

    Raises:
        InputError: as `pick_joints` and `retarget.fit` do.
    """
    settled = find_unit_and_up(recording, skeleton)
    motion = pick_joints(recording, settled)
    fitted = fit(recording, settled, motion, rest)
    clip = to_body(motion, fitted, rest, name, fps or recording.fps)
    if floor == AUTO:
        height = find_floor(clip_kinematics(clip, rest)[1], clip.fps)
    else:
        height = None if floor == NONE else float(floor) * fitted.scale
    clip = lower_clip(clip, height or 0.0)
    return Converted(
        clip=clip,
        motion=motion,
        fidelity=compare(clip, motion, rest, skeleton.name),
        floor=height,
        scale=fitted.scale,
        stance=fitted.stance.source,
        unit=float(settled.unit or 1.0),
        up=str(settled.up),
    )


def lower_clip(clip: Clip, height: float) -> Clip:
    """Return a clip moved down by a height, metres."""
    return replace(clip, trans=clip.trans - [0.0, 0.0, height])


@dataclass(frozen=True)
class StanceView:
    """The stance from which a skeleton is read, with all nodes: facing +Z, Y up, left on +X, in metres.

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
    """Return the stance from which an import reads a file's skeleton, and the body in it.

    Args:
        recording: the file's motion.
        skeleton: the file's skeleton map, with the nodes spelt as in the file.
        rest: the body's rest joints (22, 3), metres.

    Raises:
        InputError: as `convert` does.
    """
    settled = find_unit_and_up(recording, skeleton)
    motion = pick_joints(recording, settled)
    fitted = fit(recording, settled, motion, rest)
    stance = fitted.stance
    rotations, body = stance.rotations @ fitted.corrections, np.zeros_like(rest)
    for joint, parent in enumerate(PARENTS[1:], start=1):
        body[joint] = body[parent] + rotations[parent] @ (rest[joint] - rest[parent])
    mapped = {joint: int(motion.nodes[JOINTS.index(joint)]) for joint in skeleton.joints}
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
    """Return the unit, metres, of a file whose legs have the given length."""
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
    along = dict(zip("yz", mean[1:].tolist(), strict=True))
    moving = max(along, key=lambda axis: along[axis])
    standing = _standing_axis(recording, nodes)
    if along[moving] >= UPRIGHT_SHARE and standing in (None, moving):
        return moving
    advice = "give --up y or z, or up in the skeleton's map"
    if standing is None or along[standing] <= -UPRIGHT_SHARE:
        x, y, z = mean
        raise InputError(
            f"{recording.path}: no up axis found, as the head is along ({x:.2f}, {y:.2f}, {z:.2f}) from the "
            f"pelvis on average; {advice}"
        )
    if along[moving] >= UPRIGHT_SHARE:
        raise InputError(
            f"{recording.path}: the person stands along {standing} in the zero pose, but along {moving} in "
            f"the motion; {advice}: --up {standing} if the person lies, else --up {moving}"
        )
    return standing


def _standing_axis(recording: Recording, nodes: dict[str, int]) -> str | None:
    """Return the axis along which the person stands in the zero pose; None if the pose is not a stance."""
    if not set(REQUIRED) <= set(nodes):
        return None
    zero, pose = recording.zero_pose(), np.zeros((len(JOINTS), 3))
    for joint, node in nodes.items():
        pose[JOINTS.index(joint)] = zero[node]
    return next((axis for axis, turn in UPRIGHT.items() if why_no_stance(pose @ turn.T) is None), None)


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

    A step is the largest distance by which a node moves relative to the root. The result is 0 for a short
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
