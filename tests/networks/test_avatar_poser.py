"""AvatarPoser and EgoPoser, part by part."""

import tiny
import torch

from memmlp.motion.body import SPARSE_DIM, SPARSE_POSITION

CLIP = tiny.clip(40)


@torch.no_grad()
def test_avatar_poser_reads_the_newest_frame_and_knows_no_order_of_the_others():
    model, window = tiny.baseline("avatar_poser").double(), torch.randn(1, 7, SPARSE_DIM).double()
    found = model.predict_rotations(window)
    torch.testing.assert_close(model.predict_rotations(window[:, [3, 1, 5, 0, 2, 4, 6]]), found)
    assert not torch.allclose(model.predict_rotations(window[:, [6, 1, 2, 3, 4, 5, 0]]), found, atol=1e-3)


@torch.no_grad()
def test_where_on_the_floor_the_person_is_does_not_matter():
    model, window = tiny.baseline("ego_poser").double(), CLIP[None, :7, :SPARSE_DIM].double()
    elsewhere = window.clone()
    elsewhere[..., SPARSE_POSITION] += torch.tensor([3.0, -2.0, 0.0] * 3)
    torch.testing.assert_close(model.predict_rotations(elsewhere), model.predict_rotations(window))
    elsewhere[..., SPARSE_POSITION] += torch.tensor([0.0, 0.0, 0.1] * 3)
    assert not torch.allclose(model.predict_rotations(elsewhere), model.predict_rotations(window), atol=1e-3)
