"""The recorder: writes files of the wearer's motion at the end, from frames that it kept on disk.

All files contain the same frames. Formats with a skeleton (BVH, glTF) have the wearer's height. An npz has no
body, and its readers use one of the network's size, so it holds the motion of the network's body.

Missing frames between two poses are interpolated. Breaks, after which the network began anew, are left out of
the files, and reported.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from memmlp.common.errors import InputError
from memmlp.live.outputs.output import BodyFrame
from memmlp.live.rotations import slerp
from memmlp.motion.body import N_JOINTS, ROOT
from memmlp.motion.clip import Clip
from memmlp.motion.exporting import format_of, write_motion

ROW = 3 * N_JOINTS + 3  # numbers of a kept frame: rotation vectors, and the root's position
LONGEST = 1.0  # seconds without a frame that are filled


class KeptFrame(NamedTuple):
    """A frame as it is kept on disk, with the network's body size.

    Attributes:
        time: seconds.
        local: rotations (22, 3, 3), relative to the parents, except for the root's, which is global.
        root: the root's position (3,), metres, AMASS' axes.
    """

    time: float
    local: np.ndarray
    root: np.ndarray


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
                raise InputError(f"--record {path}: is there already; allowed is a new file")
        if len({path.resolve() for path in paths}) < len(paths):
            raise InputError("--record: the same file twice; allowed are different files")
        self.name = "recording " + ", ".join(path.name for path in paths)
        self.paths, self.rest, self.fps, self.tell = paths, rest, fps, tell
        self.frames = _spool(paths[0])
        self.count, self.filled, self.breaks, self.scale = 0, 0, 0, 1.0
        self.last: KeptFrame | None = None

    def take(self, frame: BodyFrame) -> None:
        """Keep a frame, after interpolated frames for those that are missing before it."""
        kept = KeptFrame(frame.time, frame.local, frame.scale * frame.positions[ROOT])
        for between in self._missing(kept, frame.restarted):
            self._keep(between)
            self.filled += 1
        self._keep(kept)
        self.last, self.scale = kept, frame.scale

    def _missing(self, kept: KeptFrame, restarted: bool) -> list[KeptFrame]:
        """Return interpolated frames between the last one and this one, where no pose was made."""
        last = self.last
        if last is None:
            return []
        steps = round((kept.time - last.time) * self.fps)
        if restarted or not 0 < steps <= LONGEST * self.fps:
            self.breaks += 1
            return []
        weights = [step / steps for step in range(1, steps)]
        return [
            KeptFrame(
                last.time + weight * (kept.time - last.time),
                slerp(last.local, kept.local, weight),
                last.root + weight * (kept.root - last.root),
            )
            for weight in weights
        ]

    def _keep(self, kept: KeptFrame) -> None:
        turns = Rotation.from_matrix(kept.local).as_rotvec()
        row = np.concatenate([turns.ravel(), kept.root]).astype("<f4")
        place = self.count * row.nbytes  # where a row that was cut off by a full disk is written over
        self.frames.seek(place)
        self.frames.write(row.tobytes())
        self.count += 1

    def close(self) -> None:
        """Write the files.

        Raises:
            InputError: if a file can't be written; the other files are written all the same.
        """
        with self.frames:
            if not self.count:
                self.tell("recording: no frame came, so that nothing is written")
                return
            self.frames.flush()
            rows = np.memmap(self.frames, "<f4", "r", shape=(self.count, ROW))
            failed = [error for path in self.paths if (error := self._write(path, rows))]
        if failed:
            raise failed[0]

    def _write(self, path: Path, rows: np.ndarray) -> InputError | None:
        """Write a file, and return the error if that fails."""
        chosen = format_of(path)
        scale = self.scale if chosen.has_bones else 1.0
        rest = self.rest / scale
        poses = rows[:, :-3].reshape(-1, N_JOINTS, 3)
        clip = Clip(path.stem, poses, rows[:, -3:] / scale - rest[ROOT], self.fps)
        try:
            write_motion(path, clip, rest, chosen)
        except InputError as error:
            return error
        self.tell(f"{path}: {len(clip) / self.fps:.1f} s{self._remarks()}")
        return None

    def _remarks(self) -> str:
        """Return remarks on the files' frames, for the user: breaks and interpolated frames."""
        remarks = []
        if self.breaks:
            remarks.append(f"{self.breaks} break{'s' * (self.breaks > 1)} left out")
        if self.filled:
            remarks.append(f"{self.filled} of {self.count} frames interpolated")
        return "".join(f", {remark}" for remark in remarks)


def _spool(path: Path) -> IO[bytes]:
    """Open an unnamed temporary file on the disk of another file.

    Raises:
        InputError: if that file's folder can't be written to.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return tempfile.TemporaryFile(dir=path.parent)
    except OSError as error:
        raise InputError(
            f"--record {path}: cannot be written ({error.strerror}); allowed: a file to write"
        ) from None
