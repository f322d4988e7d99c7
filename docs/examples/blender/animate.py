"""A recorded motion as an animated armature in Blender.

    python ../python/full_body.py body.onnx trackers.csv --save motion.npz
    blender --background --python animate.py -- motion.npz --out body.blend --check

The first line runs the network (`memmlp export RUN --scope full --space amass --out body.onnx`) in any Python
with NumPy and ONNX Runtime; the second needs Blender alone (with `pip install bpy`: `python animate.py ...`).
`--check` plays all frames, and fails where a bone is more than a millimetre from its joint.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # SMPL's axes (Y up) to Blender's (Z up)
NEAR = 1e-3  # metres
TIP = 0.08  # metres: the length of a bone that has no other bone at its end
SUFFIXES = (".blend", ".glb")


class Motion(NamedTuple):
    """What full_body.py saved, turned to Blender's axes: Z up, in the rest pose facing -Y.

    Attributes:
        joints, parents: names (J), and indices of parents (J), -1 for the root.
        rest: the T-pose (J, 3), metres.
        local: rotations (N, J, 3, 3), each relative to its parent's, the root's global.
        positions: (N, J, 3), metres.
        fps: frames per second.
    """

    joints: list[str]
    parents: list[int]
    rest: np.ndarray
    local: np.ndarray
    positions: np.ndarray
    fps: float


def read_motion(path: Path) -> Motion:
    """Read a motion. The rotations begin at SMPL's T-pose, which lies in a world with Z up; ours stands."""
    with np.load(path, allow_pickle=False) as saved:
        if str(saved["space"]) != "amass":
            sys.exit(
                f"{path}: in the space {saved['space']}; Blender's is amass (memmlp export --space amass)"
            )
        if saved["rotations"].ndim != 4:
            sys.exit(
                f"{path}: rotations are quaternions; expected matrices (memmlp export without --rotations)"
            )
        local = UPRIGHT @ saved["rotations"].astype(float) @ UPRIGHT.T
        local[:, 0] = saved["rotations"][:, 0] @ UPRIGHT.T
        joints, parents = saved["joints"].tolist(), saved["parents"].tolist()
        rest, positions = saved["rest"] @ UPRIGHT.T, saved["positions"].astype(float)
        return Motion(joints, parents, rest, local, positions, float(saved["fps"]))


def tail(motion: Motion, joint: int) -> np.ndarray:
    """Return where a bone ends (3,): at the middle of the joints that hang on it, or a little further on."""
    children = [child for child, parent in enumerate(motion.parents) if parent == joint]
    end = motion.rest[children].mean(0) if children else motion.rest[joint]
    if np.linalg.norm(end - motion.rest[joint]) > 1e-2:
        return end
    along = motion.rest[joint] - motion.rest[motion.parents[joint]]
    return motion.rest[joint] + TIP * along / np.linalg.norm(along)


def build(motion: Motion) -> Any:
    """Make an armature with a bone from each joint, in the rest pose, and return its object."""
    import bpy

    armature = bpy.data.objects.new("body", bpy.data.armatures.new("body"))
    bpy.context.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    bones = [armature.data.edit_bones.new(name) for name in motion.joints]
    for joint, (bone, parent) in enumerate(zip(bones, motion.parents, strict=True)):
        bone.head, bone.tail = motion.rest[joint], tail(motion, joint)
        if parent >= 0:
            bone.parent = bones[parent]
    bpy.ops.object.mode_set(mode="OBJECT")
    return armature


def animate(armature: Any, motion: Motion) -> None:
    """Set a key for each frame: all joints turn, and the root moves.

    Blender counts a bone's rotation in the bone's own axes at rest: a turn R of the body is A^T R A for a
    bone with the axes A.
    """
    import bpy
    from mathutils import Matrix, Vector

    scene = bpy.context.scene
    scene.render.fps, scene.render.fps_base = round(motion.fps), round(motion.fps) / motion.fps
    scene.frame_start, scene.frame_end = 1, len(motion.local)
    for joint, name in enumerate(motion.joints):
        bone, last = armature.pose.bones[name], None
        axes = bone.bone.matrix_local.to_3x3()
        for frame, local in enumerate(motion.local[:, joint], 1):
            turn = (axes.transposed() @ Matrix(local.tolist()) @ axes).to_quaternion()
            if last is not None:
                turn.make_compatible(last)  # q and -q are the same turn, but not what lies between two keys
            bone.rotation_quaternion = last = turn
            bone.keyframe_insert("rotation_quaternion", frame=frame)
            if joint == 0:
                moved = motion.positions[frame - 1, 0] - motion.rest[0]
                bone.location = axes.transposed() @ Vector(moved.tolist())
                bone.keyframe_insert("location", frame=frame)


def farthest(armature: Any, motion: Motion) -> float:
    """Play all frames, and return the largest distance of a bone from its joint, metres."""
    import bpy

    worst = 0.0
    for frame, positions in enumerate(motion.positions, 1):
        bpy.context.scene.frame_set(frame)
        shown = armature.evaluated_get(bpy.context.evaluated_depsgraph_get())
        heads = [shown.matrix_world @ shown.pose.bones[name].head for name in motion.joints]
        worst = max(worst, float(np.linalg.norm(np.array(heads) - positions, axis=-1).max()))
    return worst


def save(path: Path) -> None:
    """Write the scene as a .blend or a .glb."""
    import bpy

    if path.suffix == ".glb":
        bpy.ops.export_scene.gltf(filepath=str(path.resolve()), export_anim_slide_to_zero=True)
    else:
        bpy.ops.wm.save_as_mainfile(filepath=str(path.resolve()))


def parser() -> argparse.ArgumentParser:
    """The command line, of which Blender leaves us what stands after `--`."""
    made = argparse.ArgumentParser(description="A recorded motion as an animated armature in Blender.")
    made.add_argument("motion", type=Path, help="what full_body.py --save wrote")
    made.add_argument("--out", type=Path, required=True, help="the .blend or .glb to write")
    made.add_argument("--check", action="store_true", help="measure how far the bones are from the joints")
    return made


def main() -> None:
    """Build, animate, check and save."""
    words = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    asked = parser().parse_args(words)
    if asked.out.suffix not in SUFFIXES:
        sys.exit(f"--out {asked.out}: must end in {', '.join(SUFFIXES)}")
    motion = read_motion(asked.motion)
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    armature = build(motion)
    animate(armature, motion)
    if asked.check:
        worst = farthest(armature, motion)
        print(f"{len(motion.local)} frames: a bone is at most {1000 * worst:.4f} mm from its joint")
        if not worst <= NEAR:
            sys.exit(1)
    save(asked.out)


if __name__ == "__main__":
    main()
