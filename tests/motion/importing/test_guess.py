"""Proposed maps: limbs by names, the trunk by the tree, and their YAML."""

from pathlib import Path

import pytest
from bvh_samples import refuse, write
from skeleton_families import joints, renamed, walking

from memmlp.motion.formats.bvh import Bvh, read_bvh
from memmlp.motion.importing.guess import (
    convert_with_guess,
    format_yaml,
    guess_map,
    split_node_name,
    write_map,
)
from memmlp.motion.importing.skeleton_map import find_skeleton, load_skeleton


def walks(folder: Path, name: str, turned: bool = False) -> Bvh:
    return read_bvh(write(folder, walking(name, turned).text()))


def test_words():
    for name, side, word in (
        ("LeftUpLeg", "left", "upleg"), ("lShldr", "left", "shldr"), ("UpperArm_L", "left", "upperarm"),
        ("upper_arm.R", "right", "upperarm"), ("LHipJoint", "left", "hipjoint"), ("lfemur", "left", "femur"),
        ("rclavicle", "right", "clavicle"), ("leftupleg", "left", "upleg"), ("lowerback", "", "lowerback"),
        ("RightHandThumb1", "right", "handthumb1"), ("LeftRight", "", "leftright"),
    ):  # fmt: skip
        assert split_node_name(name) == (side, word)


@pytest.mark.parametrize(
    "name", ["bandai_namco", "cmu_daz", "cmu_motionbuilder", "mixamo", "smpl", "smpl_words"]
)
def test_the_shipped_map_is_guessed_and_written(tmp_path: Path, name: str):
    bvh = walks(tmp_path, name)
    proposed = guess_map(bvh, "on: 1")
    assert proposed.skeleton.joints == load_skeleton(name).joints | WRISTS.get(name, {})
    assert not proposed.missing
    write_map(tmp_path / "mine.yaml", format_yaml(proposed, bvh))
    loaded = load_skeleton(str(tmp_path / "mine.yaml"))
    assert (loaded.name, loaded.joints) == ("on: 1", proposed.skeleton.joints)
    assert loaded.calibration_frame == proposed.skeleton.calibration_frame == name.startswith("cmu_")
    assert find_skeleton(bvh, loaded).joints == loaded.joints


WRISTS = {"cmu_motionbuilder": {"left_wrist": "LeftHand", "right_wrist": "RightHand"}}  # by their names
HDM = dict(  # names of joints in ASF files, as in HDM05 and CMU's database
    Hips="root", LHipJoint="lhipjoint", LeftUpLeg="lfemur", LeftLeg="ltibia", LeftFoot="lfoot",
    LeftToeBase="ltoes", RHipJoint="rhipjoint", RightUpLeg="rfemur", RightLeg="rtibia", RightFoot="rfoot",
    RightToeBase="rtoes", LowerBack="lowerback", Spine="upperback", Spine1="thorax", Neck="lowerneck",
    Neck1="upperneck", Head="head", LeftShoulder="lclavicle", LeftArm="lhumerus", LeftForeArm="lradius",
    LeftHand="lwrist", LeftFingerBase="lhand", RightFingerBase="rhand", RightShoulder="rclavicle",
    RightArm="rhumerus", RightForeArm="rradius", RightHand="rwrist",
)  # fmt: skip


DAZ = {"LeftUpLeg": "lThighBend", "LeftArm": "lShldrBend", "LeftForeArm": "lForearmBend"}


@pytest.mark.parametrize("others", [{}, DAZ, {"LeftArm": "LUArm", "LeftForeArm": "LFArm"}])
def test_names_of_another_program_are_known(tmp_path: Path, others: dict[str, str]):
    names = HDM | others
    bvh = renamed(walks(tmp_path, "cmu_motionbuilder"), names)
    proposed = guess_map(bvh, "mine")
    nodes = load_skeleton("cmu_motionbuilder").joints | WRISTS["cmu_motionbuilder"]
    expected = {joint: names[node] for joint, node in nodes.items()}
    assert proposed.skeleton.joints == expected


def test_a_proposed_map_imports(tmp_path: Path):
    bvh = walks(tmp_path, "lafan1", turned=True)
    done = convert_with_guess(bvh, guess_map(bvh, "mine"))
    assert "straightest" in done.fitted.stance.source
    assert done.fidelity.faults == ()


def test_a_prefix_that_the_root_lacks_does_not_hide_the_head(tmp_path: Path):
    bvh = walks(tmp_path, "iclone")
    root, *others = joints(bvh)
    bvh = renamed(bvh, {root: "RL_BoneRoot"} | {joint: f"CC_Base_{joint}" for joint in others})
    assert guess_map(bvh, "mine").skeleton.joints["head"] == "CC_Base_Head"


def test_a_joint_without_a_known_name_is_left_to_the_user(tmp_path: Path):
    bvh = walks(tmp_path, "lafan1")
    names = {joint: joint for joint in joints(bvh)} | {"LeftForeArm": "bone7"}
    bvh = renamed(bvh, names)
    proposed = guess_map(bvh, "mine")
    assert proposed.missing == ("left_elbow",)
    assert "# left_elbow is required" in format_yaml(proposed, bvh)
    with refuse("joints.left_elbow"):
        convert_with_guess(bvh, proposed)
    nothing = renamed(bvh, {joint: f"bone{number}" for number, joint in enumerate(joints(bvh))})
    assert "left_hip" in guess_map(nothing, "mine").missing
