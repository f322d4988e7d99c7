"""Writing in pieces: a file is the same, however long the pieces are in which its clip is worked on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from memmlp.motion.body import builtin_rest_joints
from memmlp.motion.clip import Clip
from memmlp.motion.exporting.write import FORMATS, write_motion

REST = builtin_rest_joints()


def spinning(frames: int = 50) -> Clip:
    """Make a clip whose joints turn on and on, so that angles and quaternions must be led over each seam."""
    random = np.random.default_rng(4)
    axes = random.normal(size=(22, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    poses = np.linspace(-9, 9, frames)[:, None, None] * axes
    return Clip("spinning", poses, random.normal(size=(frames, 3)), 60.0)


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("frames", [1, 7, 49])
def test_pieces_leave_no_seam(name: str, frames: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    chosen = FORMATS[name]
    whole, parted = (tmp_path / f"{kind}{chosen.suffix}" for kind in ("whole", "parted"))
    write_motion(whole, spinning(), REST, chosen)
    monkeypatch.setattr(Clip.pieces, "__defaults__", (frames,))
    write_motion(parted, spinning(), REST, chosen)
    assert parted.read_bytes() == whole.read_bytes()


def test_only_npz_brings_no_body():
    assert [name for name, chosen in FORMATS.items() if not chosen.has_bones] == ["npz"]
