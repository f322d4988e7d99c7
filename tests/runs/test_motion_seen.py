"""How much motion a network saw, and the warning where that was next to nothing."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_runs import fake_run

from memmlp.runs.motion_seen import LITTLE, frames_seen, hardly_trained

SEEN = {"optim": {"steps": 100, "batch": 8}, "model": {"frames": 11}}


def test_a_network_saw_a_batch_of_windows_at_each_step(tmp_path: Path):
    assert frames_seen(fake_run(tmp_path, "a", config=SEEN)) == 100 * 8 * 11


def test_a_refiner_saw_its_network_s_frames_and_its_own_pieces(tmp_path: Path):
    network = fake_run(tmp_path, "network", config=SEEN)
    above = {"upstream": network.id}
    config = SEEN | {"refiner": {"frames": 20}}
    assert frames_seen(fake_run(tmp_path, "refiner", config=config, origin=above)) == 100 * 8 * (11 + 20)


@pytest.mark.parametrize("lacking", ["optim", "model"])
def test_what_is_not_known_is_0(tmp_path: Path, lacking: str):
    config = {key: value for key, value in SEEN.items() if key != lacking}
    assert frames_seen(fake_run(tmp_path, lacking, config=config)) == 0


def test_half_an_hour_is_enough_and_nothing_is_said_of_what_is_not_known():
    assert hardly_trained(LITTLE) == hardly_trained(0) == ""
    assert hardly_trained(LITTLE - 1).startswith("hardly trained (its steps saw 30 minutes of motion in all)")
    assert hardly_trained(9000).startswith("hardly trained (its steps saw 2.5 minutes of motion")
