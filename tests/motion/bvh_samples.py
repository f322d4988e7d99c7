"""Small BVH files of two shipped skeletons, and their expected refusals."""

import itertools
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from memmlp.common.errors import InputError
from memmlp.motion.body import JOINTS, PARENTS, make_builtin_rest_joints
from memmlp.motion.clip import Clip
from memmlp.motion.formats.bvh import Bvh, read_bvh
from memmlp.motion.formats.recording import END
from memmlp.motion.importing.skeleton_map import Z_UP, SkeletonMap, load_skeleton

REST = make_builtin_rest_joints()
# Joint, parent, offset; a * before an end site's joint, which comes with the offset only.
DAZ = """
hip - 0 0 0; abdomen hip 0 20.7 -0.7; chest abdomen 0 11.7 -0.5; neck chest 0 22.2 -2.2; head neck -0.2
7.1 1.2; leftEye head 4.1 8 8; *leftEye 1 0 0; lCollar chest 2.7 19.3 -4.9; lShldr lCollar 8.8 -2 1.5;
lForeArm lShldr 28.2 -1.7 0.5; lHand lForeArm 22.6 0.8 7.1; lThumb1 lHand 1.2 -0.5 3.4; *lThumb1 3.4 -0.5
3.4; rCollar chest -2.7 19.3 -4.9; rShldr rCollar -8.8 -2 1.5; rForeArm rShldr -28.2 -1.7 0.5; rHand
rForeArm -22.6 0.8 7.1; *rHand -1 0 0; lButtock hip 8.8 4.4 1.2; lThigh lButtock 0 -1.7 -2.2; lShin
lThigh 0 -36.8 0.7; lFoot lShin -0.7 -45.1 -5.1; *lFoot 1.1 -3.7 12.1; rButtock hip -8.8 4.4 1.2; rThigh
rButtock 0 -1.7 -2.2; rShin rThigh 0 -36.8 0.7; rFoot rShin 0.7 -45.1 -5.1; *rFoot -1.1 -3.7 12.1
"""
MOTIONBUILDER = """
Hips - 0 0 0; LHipJoint Hips 0 0 0; LeftUpLeg LHipJoint 1.86 -1.74 0.85; LeftLeg LeftUpLeg 2.37 -6.51 0;
LeftFoot LeftLeg 2.53 -6.96 0; LeftToeBase LeftFoot 0.16 -0.44 1.95; *LeftToeBase 0 0 1; RHipJoint Hips 0
0 0; RightUpLeg RHipJoint -1.68 -1.74 0.85; RightLeg RightUpLeg -2.45 -6.72 0; RightFoot RightLeg -2.44
-6.7 0; RightToeBase RightFoot -0.21 -0.57 2.02; *RightToeBase 0 0 1; LowerBack Hips 0 0 0; Spine
LowerBack 0 2.24 0; Spine1 Spine 0 2.19 -0.2; Neck Spine1 0 0 0; Neck1 Neck -0.12 1.43 0.28; Head Neck1
0.18 1.46 -0.33; *Head 0 1.5 0; LeftShoulder Spine1 0 0 0; LeftArm LeftShoulder 3.28 0.86 0.05;
LeftForeArm LeftArm 4.97 0 0; LeftHand LeftForeArm 2.24 0 0; LeftFingerBase
LeftHand 1.12 0 0; *LeftFingerBase 0.8 0 0; RightShoulder Spine1 0 0
0; RightArm RightShoulder -3.24 1.02 0.35; RightForeArm RightArm -5.22 0 0; RightHand RightForeArm -2.25
0 0; RightFingerBase RightHand -1.12 0 0; *RightFingerBase -0.6 0 0
"""
TREES = {"cmu_daz": DAZ, "cmu_motionbuilder": MOTIONBUILDER}
FOLDED = (  # unmapped, between mapped ones
    "lButtock", "rButtock", "LHipJoint", "RHipJoint", "Neck1", "LeftHand", "RightHand",
)  # fmt: skip
POSITIONS = ("Xposition", "Yposition", "Zposition")
ZXY = ("Zrotation", "Xrotation", "Yrotation")
ORDERS = [tuple(axis + "rotation" for axis in order) for order in itertools.permutations("XYZ")]
REST_ORDERS = {"cmu_daz": ZXY, "cmu_motionbuilder": ("Zrotation", "Yrotation", "Xrotation")}


@dataclass
class Sample:
    """A BVH file in the making: joints, and end sites as (joint's index, offset)."""

    names: list[str]
    parents: list[int]
    offsets: list[list[float]]
    ends: list[tuple[int, list[float]]]
    channels: list[tuple[str, ...]]
    values: np.ndarray

    def text(
        self, end: str = "\n", frames: str = "Frames:\t{}", time: str = "Frame Time: {}", dt: str = ""
    ) -> str:
        lines = [
            *["HIERARCHY", *self._joint(0), "MOTION"],
            *[frames.format(len(self.values)), time.format(dt or "0.00833333")],
            *[" ".join(map(repr, row)) for row in self.values.tolist()],
        ]
        return end.join(lines) + end

    def hierarchy(self) -> Bvh:
        nodes = (*self.names, *(self.names[joint] + END for joint, _ in self.ends))
        parents = (*self.parents, *(joint for joint, _ in self.ends))
        offsets = np.array([*self.offsets, *(offset for _, offset in self.ends)])
        return Bvh(Path("sample.bvh"), nodes, parents, offsets, 120.0, self.values, tuple(self.channels))

    def _joint(self, joint: int) -> list[str]:
        lines = [f"{'JOINT' if joint else 'ROOT'} {self.names[joint]}", "{"]
        lines += ["OFFSET " + " ".join(map(repr, self.offsets[joint]))]
        lines += [" ".join(["CHANNELS", str(len(self.channels[joint])), *self.channels[joint]])]
        for parent, offset in self.ends:
            if parent == joint:
                lines += ["End Site", "{", "OFFSET " + " ".join(map(repr, offset)), "}"]
        for child, parent in enumerate(self.parents):
            if parent == joint:
                lines += self._joint(child)
        return [*lines, "}"]


def tree(skeleton: str, seed: int = 3) -> Sample:
    """Make the skeleton of `TREES`, without motion. The rotation channels' order is drawn for each joint,
    unless the map's `rest` has values of the joint."""
    random = np.random.default_rng(seed)
    names, parents, offsets, ends = [], [], [], []
    for entry in TREES[skeleton].replace("\n", " ").split(";"):
        name, *rest = entry.split()
        if name.startswith("*"):
            ends.append((names.index(name[1:]), [float(word) for word in rest]))
        else:
            names.append(name)
            parents.append(-1 if rest[0] == "-" else names.index(rest[0]))
            offsets.append([float(word) for word in rest[1:]])
    fixed = dict.fromkeys(load_skeleton(skeleton).rest or (), REST_ORDERS[skeleton])
    channels = [fixed.get(name, ORDERS[random.integers(len(ORDERS))]) for name in names]
    channels[0] = (*POSITIONS, *channels[0])
    return Sample(names, parents, offsets, ends, channels, np.empty((0, sum(map(len, channels)))))


def person(skeleton: str, frames: int, seed: int, folded: bool = False) -> Sample:
    """Make a file of random rotations, frame 0 being the zero pose. Joints that lie between mapped ones turn
    only if `folded`."""
    sample, random = tree(skeleton, seed), np.random.default_rng([seed, 1])
    values = random.uniform(-180, 180, (frames, sample.values.shape[1]))
    values[:, :6] *= [0.01, 0.01, 0.01, 0.1, 0.1, 0.1]  # nobody is faster
    values[0, 3:] = 0
    for joint, name in enumerate(sample.names):
        if name in FOLDED and not folded:
            values[:, 3 + 3 * joint : 6 + 3 * joint] = 0
    return replace(sample, values=values)


def write(folder: Path, text: str | bytes, name: str = "clip.bvh") -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def read(folder: Path, skeleton: str, frames: int = 5, **options: int) -> Bvh:
    return read_bvh(write(folder, person(skeleton, frames, **{"seed": 3, **options}).text(dt="0.1")))


@contextmanager
def refuse(start: Path | str, *said: str) -> Iterator[None]:
    """Expect an InputError of one line that begins with `start` and contains all of `said`."""
    with pytest.raises(InputError) as error:
        yield
    message = str(error.value)
    assert message.startswith(str(start))
    assert len(message.splitlines()) == 1
    for part in said:
        assert part in message


def own_tree(chosen: SkeletonMap) -> Sample:
    """Make a skeleton of just the nodes that a map names, somewhat unlike the built-in body, in a T-pose."""
    order = [joint for joint in depth_first() if JOINTS[joint] in chosen.joints]
    axes = Z_UP if chosen.up == "z" else np.eye(3)
    at = (REST * [1.1, 0.9, 1.0] + [0.0, 0.0, 0.01]) @ axes.T / (chosen.unit or 0.01)
    sample = Sample([], [], [], [], [], np.empty((0, 0)))
    for joint in order:
        node, parent = chosen.joints[JOINTS[joint]], PARENTS[joint]
        while parent >= 0 and parent not in order:
            parent = PARENTS[parent]
        above = sample.names.index(chosen.joints[JOINTS[parent]]) if parent >= 0 else -1
        offset = (at[joint] - at[max(parent, 0)]).tolist()
        if node.endswith(END):
            sample.ends.append((above, offset))
        else:
            sample.names.append(node)
            sample.parents.append(above)
            sample.offsets.append(offset)
            sample.channels.append((*(POSITIONS if parent < 0 else ()), *ZXY))
    return sample


def depth_first(joint: int = 0) -> list[int]:
    """The body's joints in the order of a file."""
    below = [depth_first(child) for child, parent in enumerate(PARENTS) if parent == joint]
    return [joint, *itertools.chain(*below)]


def performed(
    chosen: SkeletonMap,
    clip: Clip,
    *,
    sample: Sample | None = None,
    corrections: np.ndarray | None = None,
    turns: np.ndarray | None = None,
) -> Sample:
    """Write a clip on the built-in body as a BVH file of a map's skeleton.

    Args:
        chosen: the map; where it has a calibration frame, the zero pose of the unturned file is frame 0.
        clip: the motion.
        sample: the skeleton, in a T-pose; by default `own_tree`.
        corrections: (22, 3, 3); a node's rotation times that is the body joint's.
        turns: rotations (joints, 3, 3), by which each of the file's joints is turned in the zero pose; the
            motion is the same.
    """
    sample = sample or own_tree(chosen)
    axes, body = Z_UP if chosen.up == "z" else np.eye(3), body_rotations(clip)
    world = axes @ Z_UP.T
    if corrections is not None:
        body = body @ corrections.swapaxes(-1, -2)
    turned = np.tile(np.eye(3), (len(clip) + 1, len(sample.names), 1, 1))
    counterparts = {node: JOINTS.index(joint) for joint, node in chosen.joints.items()}
    for index, (name, parent) in enumerate(zip(sample.names, sample.parents, strict=True)):
        if name in counterparts:
            turned[1:, index] = world @ body[:, counterparts[name]] @ axes.T
        else:
            turned[1:, index] = turned[1:, parent]
    offsets = np.array(sample.offsets)
    shin, foot = (offsets[sample.names.index(chosen.joints[end])] for end in ("left_knee", "left_ankle"))
    leg = np.linalg.norm(shin) + np.linalg.norm(foot)
    scale = leg / np.linalg.norm(REST[[4, 7]] - REST[[1, 4]], axis=-1).sum()
    values = [np.concatenate([np.zeros((1, 3)), scale * (clip.trans + REST[0]) @ world.T])]
    turns = np.tile(np.eye(3), (len(sample.names), 1, 1)) if turns is None else turns
    for joint, parent in enumerate(sample.parents):
        turn = turns[parent] if parent >= 0 else np.eye(3)
        above = turned[:, parent] @ turn if parent >= 0 else np.eye(3)[None]
        local = above.swapaxes(1, 2) @ turned[:, joint] @ turns[joint]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # gimbal lock: the rotation is right
            values.append(Rotation.from_matrix(local).as_euler(rotation_order(sample, joint), degrees=True))
        offsets[joint] = turn.T @ offsets[joint]
    ends = [(joint, (turns[joint].T @ offset).tolist()) for joint, offset in sample.ends]
    table = np.concatenate(values, 1)[0 if chosen.calibration_frame else 1 :]
    return replace(sample, offsets=offsets.tolist(), ends=ends, values=table)


def rotation_order(sample: Sample, joint: int) -> str:
    return "".join(channel[0] for channel in sample.channels[joint][-3:])


def rest_turns(chosen: SkeletonMap, sample: Sample) -> np.ndarray:
    """The joints' rotations (joints, 3, 3) in a map's `rest`: turned by these, that pose is a T-pose."""
    turns = np.empty((len(sample.names), 3, 3))
    for joint, (name, parent) in enumerate(zip(sample.names, sample.parents, strict=True)):
        angles = (chosen.rest or {}).get(name, [0, 0, 0])
        own = Rotation.from_euler(rotation_order(sample, joint), angles, degrees=True).as_matrix()
        turns[joint] = turns[parent] @ own if parent >= 0 else own
    return turns


def random_turns(sample: Sample, seed: int) -> np.ndarray:
    return Rotation.random(len(sample.names), rng=np.random.default_rng(seed)).as_matrix()


def body_rotations(clip: Clip) -> np.ndarray:
    local = Rotation.from_rotvec(clip.poses.reshape(-1, 3)).as_matrix().reshape(len(clip), -1, 3, 3)
    for joint, parent in enumerate(PARENTS[1:], start=1):
        local[:, joint] = local[:, parent] @ local[:, joint]
    return local
