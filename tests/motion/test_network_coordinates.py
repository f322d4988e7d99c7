"""Network space: there and back, and what each choice of coordinates is blind to."""

import math

import pytest
import torch

from memmlp.motion.body import FRAME_DIM, ROTATION, SPARSE_DIM, make_builtin_rest_joints
from memmlp.motion.geometry import axis_angle_to_matrix, compute_motion_frames, matrix_to_axis_angle
from memmlp.motion.network_coordinates import Heading, HeadRelative, World
from memmlp.motion.normalizer import Normalizer

REST = torch.tensor(make_builtin_rest_joints(), dtype=torch.float64)


def motion(yaw: float = 0.0, shift: tuple[float, float] = (0.0, 0.0)) -> torch.Tensor:
    """Frames (20, 252) of random motion, turned about the vertical and moved on the floor."""
    draw = torch.Generator().manual_seed(1)
    poses = 0.3 * torch.randn(21, 22, 3, generator=draw, dtype=torch.float64)
    upright = axis_angle_to_matrix(torch.tensor([math.pi / 2, 0, 0], dtype=torch.float64))
    turn = axis_angle_to_matrix(torch.tensor([0, 0, yaw], dtype=torch.float64))
    root = turn @ upright @ axis_angle_to_matrix(poses[:, 0])
    poses[:, 0] = matrix_to_axis_angle(root)
    trans = torch.randn(21, 3, generator=draw, dtype=torch.float64) @ turn.T
    return compute_motion_frames(poses, trans + torch.tensor([*shift, 0.0]), REST).float()


@pytest.mark.parametrize("coordinates", [World(), HeadRelative(), Heading()])
def test_there_and_back(coordinates):
    frames = motion(yaw=2.0, shift=(3.0, -1.0))
    normalizer = Normalizer.fit(coordinates, REST, frames)
    sparse, theta = frames[:, :SPARSE_DIM], frames[:, SPARSE_DIM:]
    origin = normalizer.find_origin(sparse)
    back = normalizer.decode_motion(normalizer.encode_motion(theta, origin), origin)
    torch.testing.assert_close(back, theta, atol=1e-5, rtol=0)
    assert not torch.allclose(normalizer.encode(frames), frames, atol=0.1)


@pytest.mark.parametrize(
    ("coordinates", "blind_to_place", "blind_to_heading"),
    [(World(), False, False), (HeadRelative(), True, False), (Heading(), True, True)],
)
def test_what_it_is_blind_to(coordinates, blind_to_place, blind_to_heading):
    normalizer = Normalizer.from_coordinates(coordinates, REST)
    here = normalizer.encode(motion())
    assert torch.allclose(here, normalizer.encode(motion(shift=(5.0, 2.0))), atol=1e-4) == blind_to_place
    assert torch.allclose(here, normalizer.encode(motion(yaw=1.3)), atol=1e-4) == blind_to_heading


def test_statistics_are_of_the_training_frames_and_the_head_is_on_its_tracker():
    frames = motion()
    encoded = Normalizer.fit(HeadRelative(), REST, frames, chunk=7).encode(frames)
    varies = Normalizer.from_coordinates(HeadRelative(), REST).encode(frames).std(0, unbiased=False) > 1e-3
    torch.testing.assert_close(encoded.mean(0), torch.zeros(FRAME_DIM), atol=1e-3, rtol=0)
    spread = encoded.std(0, unbiased=False)[varies]
    torch.testing.assert_close(spread, torch.ones_like(spread), atol=1e-3, rtol=0)
    frames = motion()
    normalizer = Normalizer.from_coordinates(World(), REST)
    positions = normalizer.compute_positions(frames[:, SPARSE_DIM:], frames[:, :SPARSE_DIM])
    truth = frames[:, SPARSE_DIM:][:, ROTATION.stop :].unflatten(-1, (22, 3))
    torch.testing.assert_close(positions, truth, atol=1e-5, rtol=0)
