"""The example for Unity, compiled by Mono against stand-ins of Unity's types, with the network run from here.
The scripts compile in C# 7, and states, axes, frames, lost trackers, calibration and the rig are right, as
far as the stand-ins (tests/examples/unity) are. Unity itself is not tested."""

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import IO

import numpy as np
import pytest
import wearer
from examples.conftest import EXAMPLES, Played, trackers
from processes import started

from memmlp.deploy.onnx_stream import open_session
from memmlp.live.rotations import matrix_to_quaternion, quaternion_to_matrix
from memmlp.live.spaces import SPACES
from memmlp.live.stream import Stream
from memmlp.motion.body import PARENTS, make_builtin_rest_joints

pytestmark = pytest.mark.slow

SPACE = SPACES["unity"]
REST = make_builtin_rest_joints() * SPACE.body
Rows = list[tuple[float, np.ndarray, str]]  # a time, trackers (3, 7) with NaN where lost, a word


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which("mcs") is None or shutil.which("mono") is None:
        pytest.skip("Mono is not installed (apt-get install mono-mcs mono-runtime)")
    path = tmp_path_factory.mktemp("unity") / "play.exe"
    sources = [*EXAMPLES.glob("unity/*.cs"), *Path(__file__).parent.glob("unity/*.cs")]
    command = ["mcs", "-langversion:7.2", "-warnaserror", f"-out:{path}", *map(str, sources)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return path


class Player:
    """Plays samples through the example.

    Attributes:
        taken: the trackers' positions (3, 3) of each frame that the network was given.
        turned: how each bone turned since the T-pose (N, 22, 3, 3), in the world.
    """

    def __init__(self, program: Path, network: Path, folder: Path):
        self.program, self.folder, self.session = program, folder, open_session(network)
        self.quaternions = False  # whether the network gives rotations as these

    def __call__(self, rows: Rows) -> np.ndarray:
        """Where the rig's bones (N, 22, 3) are after each sample."""
        names = ("model.txt", "avatar.csv", "samples.csv", "bones.csv")
        model, avatar, samples, out = files = [self.folder / name for name in names]
        parts = (self.session.get_inputs(), self.session.get_outputs())
        described = ["\n".join(" ".join(map(str, (one.name, *one.shape))) for one in part) for part in parts]
        ends = "\n\n".join(described)
        model.write_text(ends.replace("rotations 1 22 3 3", "rotations 1 22 4") if self.quaternions else ends)
        np.savetxt(avatar, REST, delimiter=",")
        samples.write_text("\n".join(",".join(written(*row)) for row in rows))
        self.taken: list[np.ndarray] = []
        command = ["mono", str(self.program), *map(str, files)]
        with started(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
            while given := self._inputs(process.stdout):
                self.taken.append(given["tracker_positions"][0])
                for made in self.session.run(None, given):
                    if self.quaternions and made.shape == (1, 22, 3, 3):
                        made = matrix_to_quaternion(made[0])
                    process.stdin.write(made.astype(np.float32).tobytes())
                process.stdin.flush()
            assert process.wait(60) == 0
        bones = np.loadtxt(out, delimiter=",").reshape(-1, 22, 7)
        self.turned = quaternion_to_matrix(bones[..., 3:])
        return bones[..., :3]

    def _inputs(self, stream: IO[bytes]) -> dict[str, np.ndarray]:
        """The inputs of the next step that the program asks for; none at its end."""
        given = {}
        for one in self.session.get_inputs():
            data = stream.read(4 * int(np.prod(one.shape)))
            if not data:
                return {}
            given[one.name] = np.frombuffer(data, np.float32).reshape(one.shape)
        return given


@pytest.fixture
def play(program: Path, played: Callable[[str], Played], tmp_path: Path) -> Player:
    return Player(program, played("unity").network, tmp_path)


def written(time: float, frame: np.ndarray, word: str) -> list[str]:
    return [repr(time), *("" if np.isnan(value) else repr(float(value)) for value in frame.ravel()), word]


def rows(frames: np.ndarray, fps: float = 60) -> Rows:
    return [(index / fps, frame, "") for index, frame in enumerate(frames)]


@pytest.fixture
def stream(step_files: Callable[[str], Path]) -> Stream:
    return Stream(step_files("mem_mlp"), space="unity")


@pytest.mark.parametrize("quaternions", [False, True])
def test_bones_are_where_the_stream_has_the_joints(quaternions: bool, play: Player, played):
    play.quaternions = quaternions
    bones = play(rows(trackers("unity")))
    assert wearer.fastest(bones) > 10
    np.testing.assert_allclose(bones, played("unity").joints, atol=1e-4)
    turns = np.stack([pose.rotations for pose in played("unity").poses])
    for joint, parent in enumerate(PARENTS[1:], 1):
        turns[:, joint] = turns[:, parent] @ turns[:, joint]
    np.testing.assert_allclose(play.turned, turns, atol=1e-4)
