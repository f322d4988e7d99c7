"""A recording: what is filled, what is left out, what is refused, and what a full disk does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from wearer import body_frame

from memmlp.common.errors import InputError
from memmlp.live.recorder import Recorder
from memmlp.live.stream import BodyFrame
from memmlp.motion.body import builtin_rest_joints
from memmlp.motion.formats.npz import read_clip

REST = builtin_rest_joints()


def frame(time: float, restarted: bool = False) -> BodyFrame:
    """A body that goes along X at 1 m/s, and whose neck turns by a radian a second."""
    local = np.tile(np.eye(3), (22, 1, 1))
    local[12] = Rotation.from_rotvec([0, time, 0]).as_matrix()
    positions = np.tile([time, 0, 1.0], (22, 1))
    return body_frame(time, local, positions, REST, restarted)


@pytest.fixture
def told() -> list[str]:
    return []


@pytest.fixture
def recording(tmp_path: Path, told: list[str]) -> Callable[..., Recorder]:
    def made(*names: str) -> Recorder:
        return Recorder([tmp_path / name for name in names], REST, 60.0, told.append)

    return made


def test_frames_that_no_pose_was_made_for_are_filled(recording, tmp_path: Path, told: list[str]):
    """Trackers at 20 Hz make three frames at once, and the newest one's pose."""
    made = recording("a.npz")
    for index in range(0, 61, 3):
        made.take(frame(index / 60))
    made.close()
    clip = read_clip(tmp_path / "a.npz", "a")
    times = np.arange(61) / 60
    np.testing.assert_allclose(clip.trans[:, 0], times, atol=1e-6)
    np.testing.assert_allclose(clip.poses[:, 12, 1], times, atol=1e-6)
    assert told == [f"{tmp_path / 'a.npz'}: 1.0 s, 40 of 61 frames interpolated"]


def test_breaks_are_left_out_and_reported(recording, tmp_path: Path, told: list[str]):
    for number, later in enumerate((10.0, 0.7, -3.0)):
        made = recording(f"{number}.npz")
        for index in range(10):
            made.take(frame(5 + index / 60))
        for index in range(10):
            made.take(frame(5 + later + index / 60, restarted=index == 0))
        made.close()
        assert len(read_clip(tmp_path / f"{number}.npz", "a")) == 20
        assert told[-1].endswith("0.3 s, 1 break left out")


def test_bad_files_are_refused_at_once_and_nothing_is_written_without_a_frame(
    recording, tmp_path: Path, told
):
    (tmp_path / "there.bvh").write_text("precious")
    for names, words in (
        (["a.fbx"], "--record .*a.fbx"),
        (["there.bvh"], "there.bvh: already exists"),
        (["a.bvh", "a.bvh"], "the same file twice"),
        (["there.bvh/a.bvh"], "cannot be written"),
    ):
        with pytest.raises(InputError, match=words):
            recording(*names)
    assert (tmp_path / "there.bvh").read_text() == "precious"
    made = recording("new/a.bvh", "new/a.glb")
    assert list((tmp_path / "new").iterdir()) == []
    made.close()
    assert list((tmp_path / "new").iterdir()) == []
    assert len(told) == 1


def test_one_file_that_cannot_be_written_does_not_cost_the_others(recording, tmp_path: Path, told: list[str]):
    made = recording("a.npz", "b/a.bvh", "a.glb")
    made.take(frame(0.0))
    made.take(frame(1 / 60))
    (tmp_path / "b").write_text("a file where a folder is needed")
    with pytest.raises(InputError, match=r"a\.bvh: cannot be written"):
        made.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.glb", "a.npz", "b"]
    assert len(told) == 2


class Full:
    """A file that takes a part of a row and no more, once it is full."""

    def __init__(self, file):
        self.file, self.full = file, False

    def write(self, data: bytes) -> int:
        if self.full:
            self.full = False
            self.file.write(data[:100])
            raise OSError(28, "No space left on device")
        return self.file.write(data)

    def __getattr__(self, name):
        return getattr(self.file, name)


def test_a_disk_that_was_full_for_a_while_costs_those_frames_only(recording, tmp_path: Path):
    made = recording("a.npz")
    made.rows = full = Full(made.rows)
    made.take(frame(0.0))
    full.full = True
    with pytest.raises(OSError, match="No space"):
        made.take(frame(1 / 60))
    made.take(frame(2 / 60))
    made.rows = full.file
    made.close()
    clip = read_clip(tmp_path / "a.npz", "a")  # the lost frame is interpolated
    np.testing.assert_allclose(clip.trans[:, 0], np.arange(3) / 60, atol=1e-6)
