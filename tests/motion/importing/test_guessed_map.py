"""Proposed maps: by names, by tree and lengths alone, what is in doubt, and how they are written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bvh_samples import refuse, write
from skeleton_families import FAMILIES, anonymous, family, in_order, renamed, walking

from memmlp.motion.formats.bvh import Bvh, read_bvh
from memmlp.motion.importing.guessed_map import as_yaml, check, guess, write_map
from memmlp.motion.importing.skeleton_map import find_skeleton, load_skeleton


@pytest.fixture(params=FAMILIES)
def name(request: pytest.FixtureRequest) -> str:
    return request.param


def walks(folder: Path, name: str, turned: bool = False) -> Bvh:
    return read_bvh(write(folder, walking(name, turned).text()))


def test_names_give_the_shipped_map(tmp_path: Path, name: str):
    bvh = walks(tmp_path, name)
    proposed = guess(bvh, "mine")
    assert proposed.skeleton.joints == load_skeleton(name).joints
    assert not proposed.doubts


@pytest.mark.parametrize("turned", [False, True])
def test_tree_and_lengths_alone_give_it_too(tmp_path: Path, name: str, turned: bool):
    bvh = walks(tmp_path, name, turned)
    names = anonymous(bvh)
    names |= {joint + ".end": other + ".end" for joint, other in names.items()}
    proposed = guess(renamed(bvh, names), "mine")
    expected = {joint: names[node] for joint, node in load_skeleton(name).joints.items()}
    assert proposed.skeleton.joints == expected
    assert all("name" not in source for source in proposed.sources.values())
    assert any(doubt.startswith("left and right: guessed") for doubt in proposed.doubts)


def test_what_was_proposed_imports(tmp_path: Path):
    bvh = walks(tmp_path, "lafan1", turned=True)
    bvh = renamed(bvh, anonymous(bvh))
    stance, faults = check(bvh, guess(bvh, "mine"))
    assert "straightest" in stance
    assert faults == ()


def test_a_straight_person_without_feet_shows_no_left():
    sample = family("lafan1")
    for toe in ("LeftToe", "RightToe"):
        sample.offsets[sample.names.index(toe)] = [0.0, 0.0, 0.0]
    for side in ("Left", "Right"):  # knees between hips and ankles
        sample.offsets[sample.names.index(f"{side}Leg")] = [0.0, -40.0, 0.0]
        sample.offsets[sample.names.index(f"{side}Foot")] = [0.0, -40.0, 0.0]
    still = replace(sample.hierarchy(), values=np.zeros((3, sum(map(len, sample.channels)))))
    still = renamed(still, anonymous(still))
    proposed = guess(still, "mine")
    assert any("NOT KNOWN" in doubt for doubt in proposed.doubts)
    assert "NOT KNOWN" in as_yaml(proposed, still)


def test_feet_and_knees_that_contradict_each_other_show_no_left(tmp_path: Path):
    bvh = walks(tmp_path, "lafan1")
    offsets = bvh.offsets.copy()
    for toe in ("LeftToe", "RightToe"):
        offsets[bvh.names.index(toe)] *= [1, 1, -1]
    proposed = guess(renamed(replace(bvh, offsets=offsets), anonymous(bvh)), "mine")
    assert any("contradict each other" in doubt for doubt in proposed.doubts)
    assert any("NOT KNOWN" in doubt for doubt in proposed.doubts)


def test_sides_that_contradict_the_feet_are_in_doubt(tmp_path: Path):
    bvh = walks(tmp_path, "mixamo")
    swap = {"Left": "Right", "Right": "Left"}
    names = {joint: joint for joint in bvh.names}
    for joint in bvh.names:
        for side, other in swap.items():
            if joint.startswith(side):
                names[joint] = other + joint.removeprefix(side)
    proposed = guess(renamed(bvh, names), "mine")
    assert any("another left" in doubt for doubt in proposed.doubts)


def test_a_calibration_frame_is_seen(tmp_path: Path):
    assert guess(walks(tmp_path, "cmu_daz"), "mine").skeleton.calibration_frame
    assert not guess(walks(tmp_path, "mixamo"), "mine").skeleton.calibration_frame


def test_a_frame_that_may_be_a_calibration_pose_is_in_doubt(tmp_path: Path):
    bvh = walks(tmp_path, "mixamo")
    values = bvh.values.copy()
    values[0, 3:6] += [0.0, 9.0, 0.0]
    proposed = guess(replace(bvh, values=values), "mine")
    assert not proposed.skeleton.calibration_frame
    assert any("calibration pose" in doubt for doubt in proposed.doubts)


@pytest.mark.parametrize(
    ("joint", "parent", "said"),
    [("LeftUpLeg", "Head", "pairs of limbs"), ("Neck", "LeftHand", "nothing between the arms at Spine2")],
)
def test_trees_of_no_person_are_refused(joint: str, parent: str, said: str):
    sample = family("lafan1")
    sample.parents[sample.names.index(joint)] = sample.names.index(parent)
    sample = in_order(sample)
    bvh = replace(sample.hierarchy(), values=np.zeros((3, sum(map(len, sample.channels)))))
    with refuse(bvh.path, said):
        guess(bvh, "mine")


def test_the_yaml_is_a_map_of_the_same_joints(tmp_path: Path, name: str):
    bvh = walks(tmp_path, name)
    proposed = guess(bvh, "on: 1")
    text = as_yaml(proposed, bvh)
    write_map(tmp_path / "mine.yaml", text)
    loaded = load_skeleton(str(tmp_path / "mine.yaml"))
    assert (loaded.name, loaded.joints) == ("on: 1", proposed.skeleton.joints)
    assert loaded.calibration_frame == proposed.skeleton.calibration_frame
    assert find_skeleton(bvh, loaded).joints == loaded.joints
    assert text.count("# in this file") == 2


def test_guesses_are_marked(tmp_path: Path):
    bvh = walks(tmp_path, "lafan1")
    bvh = renamed(
        bvh, {joint: f"no: {n}" if joint == "LeftLeg" else joint for n, joint in enumerate(bvh.names)}
    )
    text = as_yaml(guess(bvh, "mine"), bvh)
    line = next(line for line in text.splitlines() if line.startswith("  left_knee:"))
    assert line == "  left_knee: 'no: 2'  # guessed from tree and lengths"
    assert "left_knee" in next(line for line in text.splitlines() if "without:" in line)


def test_an_existing_map_stays(tmp_path: Path):
    path = write(tmp_path, "mine", "map.yaml")
    with refuse("--out", "is there already"):
        write_map(path, "other")
    assert path.read_text() == "mine"
    with refuse("--out", "allowed: a new file"):
        write_map(tmp_path / "no" / "map.yaml", "other")
