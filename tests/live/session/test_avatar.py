"""A VRM avatar on the page: its bones stand where the joints are, whatever avatar it is."""

import json
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from chromium import Browser
from scipy.spatial.transform import Rotation
from wearer import body_frame

from memmlp.common.errors import InputError
from memmlp.live.rotations import BodyTree
from memmlp.live.session.loop import convert_to_millimetres, make_avatar_message, make_greeting
from memmlp.live.session.server import Hub, LiveServer, load_page_files
from memmlp.live.session.sources import ClipSource
from memmlp.live.stream import BodyFrame
from memmlp.motion.body import PARENTS, make_builtin_rest_joints
from memmlp.motion.formats.gltf import VRM_BONES as VRM
from memmlp.motion.formats.gltf import encode_vrm

REST = make_builtin_rest_joints()
RANDOM = np.random.default_rng(2)


def pose(size: float) -> BodyFrame:
    """A person of a size, with each joint turned by up to some 40 degrees, 30 for the whole."""
    local = Rotation.from_rotvec(RANDOM.uniform(-0.4, 0.4, (22, 3))).as_matrix()
    local[0] = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) @ local[0]
    body = BodyTree(REST).compute_positions(local)
    return body_frame(0.0, local, size * (body + np.array([0.5, -0.25, 1.6])), size * REST)


def without_chest(content: dict[str, Any]) -> None:
    """Many avatars have neither chest nor shoulders."""
    bones = content["extensions"]["VRMC_vrm"]["humanoid"]["humanBones"]
    for name in ("chest", "upperChest", "leftShoulder", "rightShoulder", "neck", "leftToes", "rightToes"):
        del bones[name]


def of_vrm_0(content: dict[str, Any]) -> None:
    """The same in VRM 0.0, where avatars face -Z."""
    bones = content["extensions"].pop("VRMC_vrm")["humanoid"]["humanBones"]
    content["extensionsUsed"] = ["VRM"]
    listed = [{"bone": name, "node": one["node"], "useDefaultValues": True} for name, one in bones.items()]
    meta = {"title": "old", "author": "nobody", "licenseName": "CC0"}
    content["extensions"]["VRM"] = {
        "specVersion": "0.0", "meta": meta, "humanoid": {"humanBones": listed},
        "blendShapeMaster": {"blendShapeGroups": []}, "firstPerson": {}, "materialProperties": [],
    }  # fmt: skip
    for node in content["nodes"]:
        if "translation" in node:
            x, y, z = node["translation"]
            node["translation"] = [-x, y, -z]


@pytest.fixture(scope="module")
def own() -> bytes:
    vrm = encode_vrm(REST)
    try:
        load_page_files(vrm)
    except InputError as error:
        pytest.skip(str(error))
    return vrm


@pytest.fixture
def browser() -> Iterator[Browser]:
    with Browser(700, 500) as browser:
        yield browser


@pytest.mark.slow
@pytest.mark.parametrize(("edit", "size"), [(lambda _: None, 1.0), (without_chest, 1.2), (of_vrm_0, 1.2)])
def test_an_avatar_s_bones_are_where_the_joints_are(browser, own: bytes, clip, edit, size: float):
    """Within what whole millimetres leave; of a wearer of another size, too. An avatar that lacks bones
    stands otherwise, but all its bones have the right direction."""
    (size_of_json,) = struct.unpack_from("<I", own, 12)
    content, rest = json.loads(own[20 : 20 + size_of_json]), own[20 + size_of_json :]
    edit(content)
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
    files = load_page_files(head + text + rest)
    person = pose(size)
    words = make_greeting(ClipSource(clip, 60), "tiny", avatar=True)["avatar"]
    given = make_avatar_message(person)
    joints = np.array(convert_to_millimetres(person.positions)).reshape(22, 3) / 1000
    script = """
      import('./avatar.js').then(async ({ Avatar }) => {
        const avatar = await Avatar.load('avatar.vrm', WORDS);
        avatar.pose(TURNS, JOINTS, HIPS);
        avatar.scene.updateMatrixWorld(true);
        const at = node => node.getWorldPosition(node.position.clone()).toArray();
        const bones = WORDS.bones.map(name => avatar.vrm.humanoid.getRawBoneNode(name));
        window.found = bones.map(node => node && at(node));
      }).catch(error => { window.failed = String(error.stack); }); 0
    """
    values = {"WORDS": words, "TURNS": given["turns"], "JOINTS": joints.ravel().tolist()}
    for name, value in {**values, "HIPS": given["hips"]}.items():
        script = script.replace(name, json.dumps(value))
    with LiveServer(Hub({}), 0, files=files) as server:
        browser.open(f"{server.url}style.css")
        browser.open(server.url)
        browser.value(script)
        browser.wait("window.found || window.failed")
        assert browser.value("window.failed") is None
        found = browser.value("window.found")
    there = [index for index, at in enumerate(found) if at]
    assert len(there) == (15 if edit is without_chest else 22)
    bones = [(joint, PARENTS[joint]) for joint in there if PARENTS[joint] in there]
    assert len(bones) == (11 if edit is without_chest else 21)
    for joint, above in bones:
        along = np.array(found[joint]) - np.array(found[above])
        assert along == pytest.approx(joints[joint] - joints[above], abs=3e-3), VRM[joint]
    if edit is not without_chest:
        assert np.linalg.norm(np.array(found) - joints, axis=1).max() < 2e-3
