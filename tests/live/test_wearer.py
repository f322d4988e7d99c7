"""Wearers of other heights and on other floors, and their calibrations as files."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import wearer as moving

from memmlp.common.errors import InputError
from memmlp.live import wearer
from memmlp.live.rotations import BodyTree, matrix_to_quaternion, quaternion_to_matrix
from memmlp.live.spaces import SPACES
from memmlp.live.stream import Stream
from memmlp.live.tracker_input import SampleWarning
from memmlp.live.tracker_resampling import make_t_pose
from memmlp.motion.body import JOINTS, make_builtin_rest_joints

REST = make_builtin_rest_joints()
BODY = BodyTree(REST)
PERSON = moving.person(np.arange(40) / 60)
HEIGHT, FLOOR = 1.95, 0.4
SIZE = HEIGHT / 1.72


@pytest.fixture
def file(step_files: Callable[[str], Path]) -> Path:
    return step_files("no_memory")


def test_the_floor_comes_to_zero():
    assert wearer.compute_body_height(BODY) == pytest.approx(1.72)
    assert wearer.make_wearer(BODY).scale == 1
    tall = wearer.make_wearer(BODY, 2.0, 0.3)
    standing = np.array([[0.5, -0.25, 0.3], [0.0, 0.0, 2.3]])  # on the floor, and the top of the head
    np.testing.assert_allclose(tall.scale_to_network(standing)[:, 2], [0, 1.72], atol=1e-12)
    for key, values in {
        "height": (0.1, 180, float("nan"), "tall"),
        "floor": (1e3, float("inf"), None),
    }.items():
        for value in values:
            with pytest.raises(InputError, match=f"{key}="):
                wearer.make_wearer(BODY, **{key: value})


@pytest.mark.slow
@pytest.mark.parametrize("name", SPACES)
def test_a_tall_wearer_on_a_raised_floor_moves_as_the_network_s_body(name: str, file: Path):
    """The same stream in every space, from and to quaternions."""
    space = SPACES[name]

    def there(positions: np.ndarray) -> np.ndarray:
        return space.convert_positions_from_amass(positions * SIZE + [0, 0, FLOOR])

    plain = moving.play(Stream(file), PERSON.positions, PERSON.rotations)
    tall = Stream(file, space=name, rotations="quaternion", height=HEIGHT, floor=FLOOR)
    turns = matrix_to_quaternion(space.convert_rotations_from_amass(PERSON.rotations).reshape(-1, 3, 3))
    poses = moving.play(tall, there(PERSON.positions), turns.reshape(-1, 3, 4))
    for here, pose in zip(plain, poses, strict=True):
        np.testing.assert_allclose(pose.positions, there(here.positions), atol=1e-4)
        np.testing.assert_allclose(pose.position_branch, there(here.position_branch), atol=1e-4)
        assert pose.rotations.shape == (22, 4)
        np.testing.assert_allclose(
            quaternion_to_matrix(pose.rotations), space.convert_pose_from_amass(here.rotations), atol=1e-4
        )
    np.testing.assert_allclose(tall.rest, make_builtin_rest_joints() * SIZE)


@pytest.mark.slow
def test_another_height_restarts_the_stream_and_forgets_offsets_with_a_warning(file: Path):
    """Kept, the offsets would hold the hands some centimetres away."""
    offsets = wearer.Offsets(np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1)))
    stream = Stream(file, height=HEIGHT, offsets=offsets)
    moving.play(stream, PERSON.positions, PERSON.rotations)
    stream.fit(HEIGHT, FLOOR)
    assert stream.offsets is not None
    assert stream.step(*zip(PERSON.positions[0], PERSON.rotations[0], strict=True)).restarted
    assert (stream.wearer.height, stream.wearer.floor) == (HEIGHT, FLOOR)
    assert stream.step_seconds > 0
    with pytest.warns(SampleWarning, match="offsets: "):
        stream.fit(HEIGHT - 0.1)
    assert stream.offsets is None
    stream.fit(HEIGHT)  # without offsets there is nothing to say


@pytest.mark.slow
def test_calibration_is_in_metres_of_the_wearer(file: Path):
    """Devices exactly on the joints of a tall person in T-pose have no offsets; without a height they do."""
    pose = make_t_pose(BODY, np.array([0.3, 0.2, 1.6]), 0.7)
    devices = list(zip(pose.positions * SIZE + [0, 0, FLOOR], pose.rotations, strict=True))
    fitted = Stream(file, height=HEIGHT, floor=FLOOR).calibrate(*devices)
    assert np.abs(fitted.positions).max() < 1e-6
    assert np.abs(fitted.rotations - np.eye(3)).max() < 1e-6
    assert np.abs(Stream(file).calibrate(*devices).positions).max() > 0.05
    # After calibration a T-pose has the tall body's hands, whatever the devices.
    pose = make_t_pose(BODY, np.array([0.0, 0.0, 1.58]), 0.0)
    joints = pose.positions * SIZE
    away = np.array([[0, -0.09, 0.05], [0.06, 0, 0], [-0.06, 0, 0]])
    devices = list(zip(joints + away, pose.rotations, strict=True))
    stream = Stream(file, height=HEIGHT)
    stream.calibrate(*devices)
    head = stream.step(*devices).positions[JOINTS.index("head")]
    assert np.linalg.norm(head - (joints[0] + away.mean(0))) < 1e-6


TURNS = np.stack([np.eye(3), np.eye(3)[[1, 2, 0]], np.diag([1.0, -1, -1])])
WORDS = {
    "memmlp": "calibration", "space": "unity", "height": 1.8, "floor": 0,
    "joints": (REST[BODY.tracked] - [0, REST[:, 1].min(), REST[BODY.tracked, 2].mean()]).tolist(),
}  # fmt: skip
WORN = wearer.Calibration("unity", wearer.Offsets(np.arange(9.0).reshape(3, 3) / 7, TURNS), 1.815, -0.02)


def test_there_and_back(tmp_path: Path):
    for made in (WORN, wearer.Calibration("openxr")):
        wearer.save_calibration(tmp_path / "me.json", made, BODY)
        again = wearer.read_calibration(tmp_path / "me.json", made.space, BODY)
        assert (again.space, again.height, again.floor) == (made.space, made.height, made.floor)
        assert (again.offsets is None) == (made.offsets is None)
        if again.offsets and made.offsets:
            for part, before in zip(again.offsets, made.offsets, strict=True):
                np.testing.assert_array_equal(part, before)
    with pytest.raises(InputError, match="cannot be written"):
        wearer.save_calibration(tmp_path / "none" / "me.json", WORN, BODY)


def wider(by: float) -> np.ndarray:
    """Return a body of the same height whose left wrist is `by` metres further out."""
    rest = REST.copy()
    rest[JOINTS.index("left_wrist"), 0] += by
    return rest


def test_offsets_of_another_space_or_body_are_refused(tmp_path: Path):
    """They would hold the hands elsewhere, silently."""
    wearer.save_calibration(tmp_path / "me.json", WORN, BODY)
    for space, rest, said in (
        ("openxr", REST, r"unity.*openxr"),
        ("unity", REST * 1.68 / 1.72, r"head or wrists are 3\.\d cm away"),
        *(("unity", wider(by), r"head or wrists are 2\.0 cm away") for by in (0.03, -0.03)),
    ):
        with pytest.raises(InputError, match=rf"me\.json: .*{said}"):
            wearer.read_calibration(tmp_path / "me.json", space, BodyTree(rest))
    near = BodyTree(wider(0.003))  # rounding
    assert wearer.read_calibration(tmp_path / "me.json", "unity", near).height == 1.815
    with pytest.raises(InputError, match=r"floor=100\.5"):
        wearer.make_wearer(BODY, floor=100.5)


@pytest.mark.parametrize("content", [
    "", "[]", "{}", "[" * 5000, '{"memmlp": "calibration", "space": "unity"}', '{"memmlp": "calibr',
    json.dumps(WORDS), json.dumps(WORDS | {"offsets": {}}), json.dumps(WORDS | {"offsets": 5}),
    json.dumps(WORDS | {"offsets": None, "joints": [1, 2]}),
    json.dumps(WORDS | {"offsets": None, "joints": [[float("nan")] * 3] * 3}),
    json.dumps(WORDS | {"offsets": {"positions": [[0] * 3] * 3, "rotations": [[[1] * 3] * 3] * 3}}),
])  # fmt: skip
def test_damaged_calibrations_are_refused(tmp_path: Path, content: str):
    (tmp_path / "me.json").write_text(content)
    with pytest.raises(InputError, match=r"me\.json"):
        wearer.read_calibration(tmp_path / "me.json", "unity", BODY)
