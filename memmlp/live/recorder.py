"""The recorder: writes files of the wearer's motion at the end, from frames that it kept on disk.

All files contain the same frames. Formats with a skeleton (BVH, glTF) have the wearer's height. An npz does
not have a body, and its readers use one of the network's size, so it holds the motion of the network's body.

Missing frames between two poses are interpolated. Breaks, after which the network restarted, are left out of
the files, and reported.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from memmlp.common.errors import InputError
from memmlp.live.rotations import slerp
from memmlp.live.stream import BodyFrame
from memmlp.motion.body import N_JOINTS, ROOT
from memmlp.motion.clip import Clip
from memmlp.motion.exporting import format_of, write_motion

ROW = 3 * N_JOINTS + 3  # numbers of a kept frame: rotation vectors, and the root's position
LONGEST = 1.0  # seconds without a frame that are filled


class Recorder:
    """An output that records to files.

    Args:
        paths: the files; their suffixes determine the formats.
        rest: the network's joints in the rest pose (22, 3), metres, SMPL's body frame.
        fps: the network's frames per second.
        tell: gets a line about each file that was written, and about breaks.

    Raises:
        InputError: for other suffixes, a file that exists, or a folder that cannot be written.
    """

    def __init__(self, paths: Sequence[Path], rest: np.ndarray, fps: float, tell: Callable[[str], None]):
        for path in paths:
            format_of(path, "--record")
            if path.exists():
                raise InputError(f"--record {path}: already exists; expected a new file")
        if len({path.resolve() for path in paths}) < len(paths):
            raise InputError("--record: the same file twice; expected different files")
        try:
            paths[0].parent.mkdir(parents=True, exist_ok=True)
            self.rows = tempfile.TemporaryFile(dir=paths[0].parent)  # noqa: SIM115, on the first file's disk
        except OSError as error:
            raise InputError(f"--record {paths[0]}: cannot be written ({error.strerror})") from None
        self.name = "recording " + ", ".join(path.name for path in paths)
        self.paths, self.rest, self.fps, self.tell = paths, rest, fps, tell
        self.count, self.filled, self.breaks, self.scale = 0, 0, 0, 1.0
        self.last: tuple[float, np.ndarray, np.ndarray] | None = None

    def take(self, frame: BodyFrame) -> None:
        """Keep a frame, after interpolated frames for those that are missing before it."""
        root = frame.scale * frame.positions[ROOT]  # in the network's body size
        if self.last is not None:
            time, local, last_root = self.last
            steps = round((frame.time - time) * self.fps)
            if frame.restarted or not 0 < steps <= LONGEST * self.fps:
                self.breaks += 1
                steps = 1
            for weight in (step / steps for step in range(1, steps)):
                self._keep(slerp(local, frame.local, weight), last_root + weight * (root - last_root))
                self.filled += 1
        self._keep(frame.local, root)
        self.last, self.scale = (frame.time, frame.local, root), frame.scale

    def _keep(self, local: np.ndarray, root: np.ndarray) -> None:
        row = np.concatenate([Rotation.from_matrix(local).as_rotvec().ravel(), root]).astype("<f4")
        self.rows.seek(self.count * row.nbytes)  # over a row that a full disk has cut off
        self.rows.write(row.tobytes())
        self.count += 1

    def close(self) -> None:
        """Write the files.

        Raises:
            InputError: if a file can't be written; the other files are written all the same.
        """
        failed = []
        with self.rows:
            if not self.count:
                self.tell("recording: no frame arrived; nothing is written")
                return
            self.rows.flush()
            rows = np.memmap(self.rows, "<f4", "r", shape=(self.count, ROW))
            for path in self.paths:
                try:
                    self._write(path, rows)
                except InputError as error:
                    failed.append(error)
        if failed:
            raise failed[0]

    def _write(self, path: Path, rows: np.ndarray) -> None:
        """Write a file, and report its length, breaks and interpolated frames."""
        chosen = format_of(path)
        scale = self.scale if chosen.has_bones else 1.0
        rest = self.rest / scale
        poses = rows[:, :-3].reshape(-1, N_JOINTS, 3)
        clip = Clip(path.stem, poses, rows[:, -3:] / scale - rest[ROOT], self.fps)
        write_motion(path, clip, rest, chosen)
        words = [f"{path}: {len(clip) / self.fps:.1f} s"]
        if self.breaks:
            words.append(f"{self.breaks} break{'s' * (self.breaks > 1)} left out")
        if self.filled:
            words.append(f"{self.filled} of {self.count} frames interpolated")
        self.tell(", ".join(words))
