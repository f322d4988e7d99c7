"""Skeleton maps: the shipped ones, which is chosen, a user's own, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from bvh_samples import TREES, person, read, refuse, write
from skeleton_families import family, joints, renamed

from memmlp.common.errors import InputError
from memmlp.motion.body import JOINTS
from memmlp.motion.formats.bvh import read_bvh
from memmlp.motion.importing import skeleton_map
from memmlp.motion.importing.import_folder import ImportSettings, import_folder
from memmlp.motion.importing.skeleton_map import SKELETONS, find_skeleton, load_skeleton, pick_joints


def test_unknown_skeleton_lists_joints_and_maps(tmp_path: Path) -> None:
    path = write(tmp_path, person("cmu_daz", 2, 0).text().replace("lShin", "shinbone"))
    with refuse(path, "shinbone", "rThigh", "cmu_daz, cmu_motionbuilder"):
        find_skeleton(read_bvh(path))


def test_a_file_of_two_skeletons_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bvh = read(tmp_path, "cmu_daz")
    for name in ("one", "two"):
        (tmp_path / f"{name}.yaml").write_text((SKELETONS / "cmu_daz.yaml").read_text())
    monkeypatch.setattr("memmlp.motion.importing.skeleton_map.SKELETONS", tmp_path)
    with refuse(tmp_path, "more than one"):
        find_skeleton(bvh)


def user_map(folder: Path, **changes: object) -> Path:
    content = yaml.safe_load((SKELETONS / "cmu_daz.yaml").read_text()) | {"name": "mine"} | changes
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in content.items() if value is not None}))
    return path


def test_a_users_map_and_what_it_leaves_out(tmp_path: Path) -> None:
    path = user_map(tmp_path, unit=0.011, calibration_frame=False)
    assert load_skeleton(str(path)).unit == 0.011
    file = write(tmp_path, person("cmu_daz", 4, 0).text())
    report = import_folder(file, tmp_path / "out", ImportSettings(skeleton=str(path)))
    assert [(clip.skeleton, clip.frames) for clip in report.clips] == [("mine", 4)]
    chosen = load_skeleton(str(user_map(tmp_path, unit=None, up="auto", calibration_frame=None, rest=None)))
    assert (chosen.unit, chosen.up, chosen.calibration_frame, chosen.rest) == (None, None, False, None)


JOINTS_OF_DAZ = load_skeleton("cmu_daz").joints


def test_wrong_maps_are_refused(tmp_path: Path) -> None:
    for changes, said in (
        ({"unit": "cm"}, "unit"), ({"unit": float("nan")}, "unit"), ({"name": None}, "keys"),
        ({"up": "x"}, "y, z or auto"), ({"calibration_frame": 1}, "true or false"),
        ({"joints": {}}, "joints.pelvis"), ({"joints": JOINTS_OF_DAZ | {"tail": "hip"}}, "joints.tail"),
        ({"joints": JOINTS_OF_DAZ | {"head": True}}, "joints.head"),
        ({"joints": JOINTS_OF_DAZ | {"head": "neck"}}, "neck"),
    ):  # fmt: skip
        path = user_map(tmp_path, **changes)
        with refuse(path, said):
            load_skeleton(str(path))
    path = write(tmp_path, user_map(tmp_path).read_text() + "\nunit: 0.02\n", "mine.yaml")
    with refuse(path, "'unit'"):  # twice
        load_skeleton(str(path))
    for text in ("", "[", "a: 1\na: 2", "!!python/name:os.system", "\0", "- 1", "{{}: 1}"):
        path = write(tmp_path, text, "mine.yaml")
        with pytest.raises(InputError, match=r"\A[^\n]*mine\.yaml[^\n]*\Z"):
            load_skeleton(str(path))


@pytest.mark.parametrize("skeleton", TREES)
def test_joints_are_those_of_the_map(tmp_path: Path, skeleton: str) -> None:
    bvh, chosen = read(tmp_path, skeleton), load_skeleton(skeleton)
    mapped_motion = pick_joints(bvh, chosen)
    positions = bvh.compute_kinematics()[1][1:] * chosen.unit
    assert len(mapped_motion) == len(bvh) - 1
    for joint, name in enumerate(JOINTS):
        assert mapped_motion.mapped[joint] == (name in chosen.joints)
        if name in chosen.joints:
            node = bvh.nodes.index(chosen.joints[name])
            np.testing.assert_array_equal(mapped_motion.positions[:, joint], positions[:, node])


def test_a_map_of_other_joints_is_refused(tmp_path: Path) -> None:
    bvh, chosen = read(tmp_path, "cmu_daz"), load_skeleton("cmu_daz")
    with refuse(bvh.path, "Hips"):
        pick_joints(bvh, load_skeleton("cmu_motionbuilder"))
    swapped = chosen.joints | {"left_knee": "lFoot", "left_ankle": "lShin"}
    with refuse(bvh.path, "lShin must be below lFoot"):
        pick_joints(bvh, replace(chosen, joints=swapped))


def test_names_of_nodes():
    for nodes, plain in (
        ("mixamorig:Hips mixamorig:LeftArm", "Hips LeftArm"), ("mixamorigHips mixamorigHead", "Hips Head"),
        ("m_avg_root m_avg_L_Hip m_avg_R_Hip", "root L_Hip R_Hip"), ("joint_1 joint_2", "1 2"),
        ("Armature a:b:Hips a:b:Head", "Armature Hips Head"), ("Spine Spine1 Spine2", "Spine Spine1 Spine2"),
    ):  # fmt: skip
        assert skeleton_map.strip_namespace(nodes.split()) == plain.split()
    nodes = ["Spine1", "spine_1", "Head"]
    assert skeleton_map.find_nodes(nodes, ["spine_1"]) == {"spine_1": "spine_1"}
    assert skeleton_map.find_nodes(nodes, ["SPINE1"]) is None  # either could be meant
    assert skeleton_map.find_nodes(nodes, ["Head", "head"]) is None  # one node for two
    assert skeleton_map.find_nodes(nodes, ["Tail"]) is None


@pytest.mark.parametrize("name", skeleton_map.list_shipped_skeletons())
def test_each_familys_file_is_known_by_its_own_map(name: str):
    bvh = family(name).hierarchy()
    bvh = renamed(bvh, {joint: "ns:" + joint for joint in joints(bvh)})
    found = find_skeleton(bvh)
    behind = {"memmlp": "smpl_words"}  # the same joints, and it presumes less
    assert found.name == behind.get(name, name)
    expected = {f"ns:{node}" for node in load_skeleton(name).joints.values()}
    assert set(found.joints.values()) == expected <= set(bvh.nodes)
    assert set(found.rest or ()) <= set(joints(bvh))
    if name == found.name:
        assert find_skeleton(bvh, load_skeleton(name)).joints == found.joints
