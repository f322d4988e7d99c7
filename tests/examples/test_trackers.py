"""The script that writes a clip's head and hands as CSV."""

import runpy
from pathlib import Path

import numpy as np
import pytest
import torch
import wearer
from examples.conftest import EXAMPLES
from scipy.spatial.transform import Rotation

from memmlp.live.spaces import SPACES
from memmlp.motion.clip import Clip
from memmlp.motion.formats.npz import write_clip


@pytest.mark.parametrize("space", SPACES)
def test_it_writes_head_and_hands_of_a_clip(space: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    random = np.random.default_rng(0)
    clip = Clip("walk", random.normal(size=(9, 22, 3)), random.normal(size=(9, 3)), 120.0)
    write_clip(tmp_path / "walk.npz", clip)
    out = tmp_path / "trackers.csv"
    monkeypatch.setattr(
        "sys.argv", ["trackers.py", str(tmp_path / "walk.npz"), "--space", space, "--out", str(out)]
    )
    runpy.run_path(str(EXAMPLES / "trackers.py"), run_name="__main__")
    header, *_ = out.read_text().splitlines()
    assert header.split(",")[:8] == ["head.x", "head.y", "head.z", *(f"head.q{a}" for a in "xyzw"), "left.x"]
    found = np.loadtxt(out, delimiter=",", skiprows=1).reshape(-1, 3, 7)
    person = wearer.of_poses(*(torch.tensor(part[::2]) for part in (clip.poses, clip.trans)))
    expected = SPACES[space].convert_positions_from_amass(person.positions)
    np.testing.assert_allclose(found[..., :3], expected, atol=1e-6)
    turned = Rotation.from_quat(found[..., 3:].reshape(-1, 4)).as_matrix().reshape(-1, 3, 3, 3)
    expected = SPACES[space].convert_rotations_from_amass(person.rotations)
    np.testing.assert_allclose(turned, expected, atol=1e-6)
