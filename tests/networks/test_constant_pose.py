"""A constant pose moves with the head, and is at first the average of its training frames."""

import pytest
import tiny
import torch

from memmlp.evaluation import modes
from memmlp.motion.body import HEAD, POSITION, ROTATION, SPARSE_DIM, SPARSE_POSITION
from memmlp.motion.geometry import sixd_to_matrix
from memmlp.motion.network_coordinates import Heading
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.constant_pose import ConstantPose, ConstantPoseSettings

CLIP = tiny.clip(40)


@pytest.fixture
def model() -> ConstantPose:
    """One that was fitted to a clip and then moved off its average."""
    model = ConstantPose(Normalizer.fit(Heading(), tiny.REST, CLIP), ConstantPoseSettings(frames=7))
    torch.nn.init.normal_(model.pose, generator=torch.Generator().manual_seed(0))
    return model.eval()


def rotations(motion: torch.Tensor) -> torch.Tensor:
    return sixd_to_matrix(motion[..., ROTATION].unflatten(-1, (22, 6)))


@torch.no_grad()
def test_the_pose_is_the_same_and_the_head_where_its_tracker_is(model: ConstantPose):
    (motion,) = modes.predict_stream(model, [CLIP])
    local = rotations(motion)
    torch.testing.assert_close(local[:, 1:], local[:1, 1:].expand(len(CLIP), -1, -1, -1))
    head = motion[:, POSITION].unflatten(-1, (22, 3))[:, HEAD]
    torch.testing.assert_close(head, CLIP[:, :SPARSE_DIM][:, SPARSE_POSITION][:, :3], atol=1e-6, rtol=0)
    assert model.count_parameters() == 132


@torch.no_grad()
def test_it_turns_with_the_head_and_with_nothing_else(model: ConstantPose):
    """The root's turns are about the vertical, and those of the head's heading."""
    (motion,) = modes.predict_stream(model, [CLIP])
    root = rotations(motion)[:, 0]
    turns = root @ root[0].T
    torch.testing.assert_close(turns[:, 2], torch.eye(3)[2].expand(len(CLIP), -1), atol=1e-5, rtol=0)
    cos, sin = model.normalizer.find_origin(CLIP[:, :SPARSE_DIM])[:, 3:].unbind(-1)
    torch.testing.assert_close(turns[:, 0, 0], cos * cos[0] + sin * sin[0], atol=1e-5, rtol=0)
    assert turns[:, 0, 0].min() < 1 - 1e-5  # it does turn
