"""`memmlp data prepare` and `inspect` tell what is doubtful about a split."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from memmlp.motion.clip import Clip
from memmlp.motion.formats.npz import write_clip


def test_folders_in_training_and_in_test_are_told(memmlp, tmp_path: Path):
    rng = np.random.default_rng(0)
    for person in ("anna", "ben"):
        for take in range(8):
            poses = 0.05 * np.cumsum(rng.normal(size=(90, 22, 3)), 0)
            clip = Clip("", poses, 0.01 * np.cumsum(rng.normal(size=(90, 3)), 0), 60.0)
            write_clip(tmp_path / "own" / person / f"{take}.npz", clip)
    cache = str(tmp_path / "cache")
    prepared = memmlp("data", "prepare", str(tmp_path / "own"), "--out", cache, "--test", "0.4")
    for ran in (prepared, memmlp("data", "inspect", cache)):
        assert ran.code == 0, ran.err
        assert "test clips are tied to no others (data.split.groups)" in ran.out
