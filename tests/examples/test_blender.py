"""The example for Blender: an armature that moves as the prediction does, in the files that it saves."""

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from examples.conftest import EXAMPLES, Played

from memmlp.motion.body import JOINTS

pytestmark = pytest.mark.slow

READ = """
import json, sys, bpy
path = sys.argv[-1]
if path.endswith(".glb"):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = 60
    bpy.ops.import_scene.gltf(filepath=path)
else:
    bpy.ops.wm.open_mainfile(filepath=path)
(armature,) = [one for one in bpy.data.objects if one.type == "ARMATURE"]
first = 1 if path.endswith(".blend") else 0
frames = []
for frame in range(first, first + COUNT):
    bpy.context.scene.frame_set(frame)
    shown = armature.evaluated_get(bpy.context.evaluated_depsgraph_get())
    heads = {bone.name: list(shown.matrix_world @ bone.head) for bone in shown.pose.bones}
    frames.append([heads[name] for name in NAMES])
print("READ", json.dumps(frames))
"""


def blender() -> list[str]:
    """The command that runs a script: Blender, or a Python with bpy (MEMMLP_BPY may name one)."""
    if given := os.environ.get("MEMMLP_BPY"):
        return [given]
    if importlib.util.find_spec("bpy"):
        return [sys.executable]
    if found := shutil.which("blender"):
        return [found, "--background", "--python-exit-code", "1", "--python"]
    pytest.skip("neither blender nor bpy (PyPI, 300 MB) is here; MEMMLP_BPY may name a Python with bpy")


def ran(script: Path, *words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [*blender(), str(script), "--", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def test_bones_stand_at_the_joints_of_the_stream(played: Callable[[str], Played], tmp_path: Path):
    blender()
    clip, motion = played("amass"), tmp_path / "motion.npz"
    script = [sys.executable, EXAMPLES / "python/full_body.py", clip.network, clip.trackers, "--save", motion]
    subprocess.run(script, check=True, timeout=300)
    animate, read = EXAMPLES / "blender/animate.py", tmp_path / "read.py"
    read.write_text(READ.replace("COUNT", str(len(clip.joints))).replace("NAMES", str(JOINTS)))
    for out in (tmp_path / "body.blend", tmp_path / "body.glb"):
        done = ran(animate, motion, "--out", out, "--check")
        assert done.returncode == 0, done.stderr
        assert f"{len(clip.joints)} frames: a bone is at most 0.00" in done.stdout
        (line,) = [line for line in ran(read, out).stdout.splitlines() if line.startswith("READ ")]
        np.testing.assert_allclose(json.loads(line.removeprefix("READ ")), clip.joints, atol=1e-3)

    with np.load(motion) as saved:
        arrays = {name: saved[name].copy() for name in saved.files}
    arrays["positions"][-1, 20] += [0, 2e-3, 0]
    np.savez(tmp_path / "other.npz", **arrays)
    done = ran(animate, tmp_path / "other.npz", "--out", tmp_path / "a.blend", "--check")
    assert done.returncode == 1
    assert re.search(r"at most (2\.00|1\.99)", done.stdout)
    np.savez(tmp_path / "unity.npz", **arrays | {"space": np.array("unity")})
    done = ran(animate, tmp_path / "unity.npz", "--out", tmp_path / "a.blend")
    assert done.returncode == 1
    assert "in the space unity; Blender's is amass" in done.stderr
    assert not (tmp_path / "a.blend").exists()
