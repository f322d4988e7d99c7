"""`memmlp live`: what it refuses in one line, and a recording that another process ends."""

import contextlib
import itertools
import json
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from conftest import Memmlp, one_line
from glb import Glb
from processes import PATIENCE, hearing_interrupts, started

from memmlp.cli.live import LiveOptions, load_tracked_clip
from memmlp.common.errors import InputError
from memmlp.common.files import write_json
from memmlp.motion.body import PARENTS, RECORD, describe_body, make_builtin_rest_joints
from memmlp.motion.formats.npz import read_clip, write_clip
from memmlp.motion.synthetic import synthesize_clip

REFUSED = {
    "--height 186": "--height", "--height 1.8": "--height: needs --udp PORT",
    "--space unity": "--space unity", "--hz 90 --udp 9000": "--hz",
    "--sender 192.168.1.9": "--sender: needs --udp PORT", "--udp 9001 --sender nowhere": "nowhere",
    "--udp 9001 --token a-token-of-many-letters": "--token: ",
    "--udp 9001 --host 0.0.0.0 --token short": "--token: ", "--vmc 127.0.0.1:none": "--vmc",
    "--clip {clip} --avatar none.vrm": "--avatar none.vrm: no such file",
    "--clip {clip} --avatar {clip}": "--avatar", "--clip {clip} --record a.fbx": "--record a.fbx",
    "--clip {clip} --record {clip}": "already exists",
    "--clip {clip} --vrchat nowhere.invalid": "--vrchat nowhere.invalid",
    "--udp 9001 --calibration {clip}": "walk.npz",
}  # fmt: skip


def test_bad_options_are_refused(memmlp: Memmlp, clip: Path, step: Path):
    for words, said in REFUSED.items():
        line = [word.format(clip=clip) for word in words.split()]
        assert one_line(memmlp("live", str(step), "--no-browser", "--port", "0", *line), said), words


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("clip") / "walk.npz"
    write_clip(path, synthesize_clip("walking", 0, seconds=2.0, fps=60.0))
    return path


@pytest.fixture
def step(step_files) -> Path:
    return step_files("no_memory")


def test_a_clip_of_a_file_is_on_the_network_s_body(step: Path, clip: Path, tmp_path: Path):
    """As in `memmlp predict`: trackers of another body would be those of another person than it learned."""
    model = onnx.load(step)
    (told,) = [entry for entry in model.metadata_props if entry.key == "rest"]
    rest = 0.9 * np.array(json.loads(told.value))
    told.value = json.dumps(rest.tolist())
    onnx.save(model, tmp_path / "small.onnx")
    given = LiveOptions(str(tmp_path / "small.onnx"), tmp_path, clip=str(clip))
    joints = load_tracked_clip(given).joints
    for joint, parent in enumerate(PARENTS[1:], 1):
        bone = np.linalg.norm(joints[:, joint] - joints[:, parent], axis=-1)
        np.testing.assert_allclose(bone, np.linalg.norm(rest[joint] - rest[parent]), atol=1e-5)
    (tmp_path / "mine").mkdir()
    copied = tmp_path / "mine" / clip.name
    copied.write_bytes(clip.read_bytes())
    write_json(tmp_path / "mine" / RECORD, describe_body("builtin", make_builtin_rest_joints()))
    with pytest.raises(InputError, match=r"mine: .*builtin"):
        load_tracked_clip(given._replace(clip=str(copied)))


@pytest.mark.slow
def test_a_recording_is_whole_when_the_command_is_ended(step: Path, clip: Path, tmp_path: Path):
    files = [tmp_path / f"me.{kind}" for kind in ("npz", "glb")]
    line = [sys.executable, "-m", "memmlp.cli.main", "live", str(step), "--clip", str(clip), "--no-browser"]
    for path in files:
        line += ["--record", str(path)]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with contextlib.ExitStack() as running:
        with hearing_interrupts():
            process = running.enter_context(started([*line, "--port", "0"], **pipes))
        address = process.stdout.readline().split()[0]
        assert "me.npz, me.glb" in process.stdout.readline()
        with urllib.request.urlopen(f"{address}events", timeout=PATIENCE) as events:
            frames = (line for line in events if line.startswith(b"event: frame"))
            list(itertools.islice(frames, 5))
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, said
    frames = len(read_clip(files[0], "me"))
    assert len(Glb(files[1]).channels()["head", "rotation"][0]) == frames >= 5
    assert all(f"{path}: {frames / 60:.1f} s" in said for path in files)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["me.glb", "me.npz"]
