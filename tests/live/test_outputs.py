"""Outputs: VMC and VRChat by their specifications, recorded files, and failures that stay with one output."""

import errno
import socket
from contextlib import nullcontext
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import tiny
import torch
import wearer
from glb import Glb
from hypothesis import example, given
from hypothesis import strategies as st
from plain_kinematics import bvh_positions
from scipy.spatial.transform import Rotation
from vmc_receiver import TREE, Marionette, posed
from wearer import body_frame

from memmlp.common.errors import InputError
from memmlp.live.outputs import VMC, Outputs, Receiver, Recorder, VRChat, compute_euler_angles, place_trackers
from memmlp.live.spaces import SPACES
from memmlp.live.stream import BodyFrame, Stream
from memmlp.motion.body import JOINTS, N_JOINTS, make_builtin_rest_joints
from memmlp.motion.clip import Clip
from memmlp.motion.formats.gltf import UNITY_BONES
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.geometry import axis_angle_to_matrix, forward_kinematics

REST = make_builtin_rest_joints()
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # of a person in AMASS' world who looks along -Y
AROUND = Rotation.from_euler("y", 180, degrees=True).as_matrix()  # so that the person looks along Unity's +Z
ETHERNET = 1472  # bytes of a datagram that is not split


def test_a_failing_output_is_reported_once_and_the_others_continue():
    lines: list[str] = []
    failing, keeping = (Mock(**{"close.side_effect": InputError("not closed")}) for _ in range(2))
    failing.name = "failing"
    failing.take.side_effect = OSError(101, "Network is unreachable")
    outputs = Outputs([failing, keeping], lines.append)
    for _ in range(3):
        outputs.take(frame(0.0))
    with pytest.raises(InputError, match="not closed"):
        outputs.close()
    (line,) = lines
    assert line.startswith("failing: Network is unreachable")
    for one in (failing, keeping):
        assert (one.take.call_count, one.close.call_count) == (3, 1)


def test_a_busy_network_drops_a_datagram_and_other_errors_are_raised():
    receiver = Receiver("127.0.0.1", 39539, "--vmc")
    receiver.socket.close()
    for state in (errno.EAGAIN, errno.ENOBUFS, errno.ENETUNREACH):
        receiver.socket = Mock(**{"sendto.side_effect": OSError(state, "as it is")})
        with pytest.raises(OSError, match="as it is") if state == errno.ENETUNREACH else nullcontext():
            receiver.send(b"")


def test_a_name_with_both_addresses_is_reached_by_its_ipv4_address(monkeypatch: pytest.MonkeyPatch):
    """Programs listen there, while `localhost` is ::1 first on many machines."""
    v6 = (socket.AF_INET6, socket.SOCK_DGRAM, 17, "", ("::1", 39539, 0, 0))
    v4 = (socket.AF_INET, socket.SOCK_DGRAM, 17, "", ("127.0.0.1", 39539))
    for found, expected in (([v6, v4], "127.0.0.1:39539"), ([v6], "::1:39539")):
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_, found=found, **__: found)
        receiver = Receiver("localhost", 39539, "--vmc")
        assert str(receiver) == expected
        receiver.socket.close()


SECONDS, HEIGHT, FLOOR = 5, 1.86, 0.25
SIZE = HEIGHT / 1.72  # the wearer's over the built-in body's
MILLIMETRE = 1e-3


@pytest.mark.slow
def test_vmc_and_files_have_the_joints_of_a_tall_wearer_s_stream(tmp_path: Path, step_files):
    space, count = SPACES["openxr"], 60 * SECONDS
    person = wearer.person(np.arange(count) / 60)
    stream, shown = (
        Stream(step_files("no_memory"), space="openxr", height=HEIGHT, floor=FLOOR) for _ in range(2)
    )
    marionette = Marionette()
    files = {kind: tmp_path / f"played.{kind}" for kind in ("npz", "bvh", "glb")}
    recorder = Recorder(list(files.values()), stream.network.body.rest, stream.network.fps, print)
    outputs = Outputs([VMC(Receiver("127.0.0.1", marionette.port, "--vmc")), recorder], pytest.fail)
    positions = space.convert_positions_from_amass(person.positions * SIZE + [0, 0, FLOOR])
    rotations = space.convert_rotations_from_amass(person.rotations)
    poses, received = [], []
    for index in range(count):
        trackers = list(zip(positions[index], rotations[index], strict=True))
        outputs.take(stream.step_body(*trackers, time=5 + index / 60))
        pose = shown.step(*trackers, time=index / 60)
        addresses = [message.address for message in marionette.receive() + marionette.receive()]
        poses.append(pose.positions - [0, FLOOR, 0])
        received.append([marionette.root, *(marionette.bones[name] for name in UNITY_BONES)])
    outputs.close(), marionette.close()
    assert addresses == ["/VMC/Ext/OK", "/VMC/Ext/T", "/VMC/Ext/Root/Pos", *22 * ["/VMC/Ext/Bone/Pos"]]
    assert marionette.loaded
    assert marionette.time == pytest.approx(SECONDS - 1 / 60, abs=1e-3)  # it begins at zero
    poses = np.array(poses)
    assert np.ptp(poses, 0).max() > 1
    root, *bones = np.array(received).swapaxes(0, 1)
    at = posed(root, dict(zip(UNITY_BONES, bones, strict=True)))
    joints = np.stack([at[name] for name in UNITY_BONES], 1)
    assert apart(joints, poses * [1, 1, -1]) < MILLIMETRE  # OpenXR's z is Unity's -z

    found = bvh_positions(files["bvh"])
    assert apart(np.stack([found[name] for name in JOINTS], 1) / 100, poses) < MILLIMETRE
    glb = Glb(files["glb"])
    times, _ = glb.channels()["pelvis", "rotation"]
    np.testing.assert_allclose(times, np.arange(count) / 60, atol=1e-4)
    for index in range(0, count, 97):
        world = glb.matrices(index)
        assert apart(np.stack([world[name][:3, 3] for name in JOINTS]), poses[index]) < MILLIMETRE
    clip = read_clip(files["npz"], "played")  # on a body of the network's size
    assert (len(clip), clip.fps) == (count, 60)
    local = axis_angle_to_matrix(torch.tensor(clip.poses, dtype=torch.float64))
    root = torch.tensor(clip.trans, dtype=torch.float64) + tiny.REST[0]
    joints = forward_kinematics(local, root, tiny.REST)[1].numpy().reshape(-1, N_JOINTS, 3)
    assert apart(joints, space.convert_positions_to_amass(poses) / SIZE) < MILLIMETRE


def apart(ours: np.ndarray, theirs: np.ndarray) -> float:
    assert ours.shape == theirs.shape
    return np.linalg.norm(ours - theirs, axis=-1).max()


def test_vmc_datagrams_are_small_and_a_t_pose_is_the_identity():
    """Who looks along AMASS' -Y looks along Unity's -Z: the hips are turned by half, all else by nothing."""
    marionette, local = Marionette(), np.tile(np.eye(3), (22, 1, 1))
    local[0] = UPRIGHT
    vmc = VMC(Receiver("127.0.0.1", marionette.port, "--vmc"))
    t_pose = body_frame(5.0, local, np.tile([0, 0, 0.98], (22, 1)), REST)
    vmc.take(t_pose)
    assert max(len(marionette.socket.recv(65_536)) for _ in range(2)) <= ETHERNET
    vmc.take(t_pose)
    marionette.receive(), marionette.receive()
    assert set(marionette.bones) == set(TREE)
    turns = {name: bone[3:] for name, bone in marionette.bones.items()}
    assert np.abs(turns.pop("Hips")) == pytest.approx([0, 1, 0, 0], abs=1e-6)
    assert np.array(list(turns.values())) == pytest.approx(np.tile([0, 0, 0, 1.0], (21, 1)), abs=1e-6)
    assert marionette.positions()["LeftToes"] == pytest.approx([0.115, 0, -0.095], abs=1e-6)
    marionette.close()
    vmc.take(t_pose)  # without a receiver
    vmc.close()


def of_axis(axis: int, degrees: float) -> np.ndarray:
    """Unity's turn about one of its axes, as a matrix on its coordinates."""
    return Rotation.from_euler("xyz"[axis], degrees, degrees=True).as_matrix()


ANGLE = st.sampled_from([0.0, 90.0, -90.0, 180.0]) | st.floats(-180, 180)


@given(ANGLE, ANGLE, ANGLE)
@example(90.0, 30.0, 20.0)
@example(-90.0, 30.0, 20.0)
def test_angles_are_applied_about_z_then_x_then_y(x: float, y: float, z: float):
    expected = of_axis(1, y) @ of_axis(0, x) @ of_axis(2, z)
    again = compute_euler_angles(expected[None])[0]
    found = of_axis(1, again[1]) @ of_axis(0, again[0]) @ of_axis(2, again[2])
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_vrchat_gets_trackers_with_the_limbs_rotations():
    """A thigh that is lifted turns the knee's tracker; the shank does not. Positions count their joint."""
    local = np.tile(np.eye(3), (22, 1, 1))
    for name, axis, angle in (("left_hip", "x", -60), ("left_knee", "x", 80), ("head", "y", -30)):
        local[JOINTS.index(name)] = Rotation.from_euler(axis, angle, degrees=True).as_matrix()
    local[0] = UPRIGHT @ AROUND
    person = body_frame(0.0, local, np.arange(22.0)[:, None] * [1, 10, 100], REST)
    found = place_trackers(person)
    lower = ("left_ankle", "right_ankle", "left_knee", "right_knee")
    names = ["pelvis", "spine3", *lower, "left_elbow", "right_elbow", "head"]
    index = np.array([JOINTS.index(name) for name in names], float)
    np.testing.assert_allclose(found[:, 0], index[:, None] * [1, 100, 10])  # Unity's y is AMASS' z
    angles = dict(zip(names, found[:, 1], strict=True))
    assert angles["left_knee"] == pytest.approx([-60, 0, 0], abs=1e-6)  # Unity's positive X looks down
    assert angles["left_ankle"] == pytest.approx([20, 0, 0], abs=1e-6)
    assert angles["head"] == pytest.approx([0, 30, 0], abs=1e-6)  # clockwise, seen from above

    receiver = Marionette()
    sender = VRChat(Receiver("127.0.0.1", receiver.port, "--vrchat"))
    sender.take(person)
    messages = receiver.receive()
    sender.close(), receiver.close()
    kinds = [f"{name}/{part}" for name in [*range(1, 9), "head"] for part in ("position", "rotation")]
    assert [m.address for m in messages] == [f"/tracking/trackers/{kind}" for kind in kinds]
    np.testing.assert_allclose([m.values for m in messages], found.reshape(-1, 3), atol=1e-4)


def frame(time: float, restarted: bool = False) -> BodyFrame:
    """A body that goes along X at 1 m/s, whose neck turns by a radian a second."""
    local = np.tile(np.eye(3), (22, 1, 1))
    local[12] = Rotation.from_rotvec([0, time, 0]).as_matrix()
    return body_frame(time, local, np.tile([time, 0, 1.0], (22, 1)), REST, restarted)


def test_missing_frames_are_interpolated_and_breaks_left_out(tmp_path: Path):
    """Trackers at 20 Hz make three frames at once, and the newest one's pose."""
    lines, path = [], tmp_path / "a.npz"

    def record(*frames: BodyFrame) -> Clip:
        path.unlink(missing_ok=True)
        recorder = Recorder([path], REST, 60.0, lines.append)
        for one in frames:
            recorder.take(one)
        recorder.close()
        return read_clip(path, "a")

    clip, times = record(*(frame(index / 60) for index in range(0, 61, 3))), np.arange(61) / 60
    np.testing.assert_allclose(clip.trans[:, 0], times, atol=1e-6)
    np.testing.assert_allclose(clip.poses[:, 12, 1], times, atol=1e-6)
    assert lines == [f"{path}: 1.0 s, 40 of 61 frames interpolated"]
    for later in (15.0, 5.7, 2.0):
        before = [frame(5 + index / 60) for index in range(10)]
        assert len(record(*before, *(frame(later + n / 60, restarted=n == 0) for n in range(10)))) == 20
        assert lines[-1].endswith("0.3 s, 1 break skipped")


def test_bad_files_are_rejected_at_once_and_nothing_is_written_without_a_frame(tmp_path: Path):
    (tmp_path / "there.bvh").write_text("precious")
    for names, words in (
        (["a.fbx"], "--record .*a.fbx"), (["there.bvh"], "there.bvh: already exists"),
        (["a.bvh", "a.bvh"], "the same file twice"), (["there.bvh/a.bvh"], "cannot be written"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=words):
            Recorder([tmp_path / name for name in names], REST, 60.0, pytest.fail)
    assert (tmp_path / "there.bvh").read_text() == "precious"
    lines: list[str] = []
    Recorder([tmp_path / "new" / "a.bvh"], REST, 60.0, lines.append).close()
    assert (list((tmp_path / "new").iterdir()), len(lines)) == ([], 1)
