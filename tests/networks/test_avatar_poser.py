"""AvatarPoser, part by part."""

import tiny
import torch

from memmlp.motion.body import SPARSE_DIM


@torch.no_grad()
def test_avatar_poser_reads_the_newest_frame_and_knows_no_order_of_the_others():
    model, window = tiny.baseline("avatar_poser").double(), torch.randn(1, 7, SPARSE_DIM).double()
    found = model.predict_rotations(window)
    torch.testing.assert_close(model.predict_rotations(window[:, [3, 1, 5, 0, 2, 4, 6]]), found)
    assert not torch.allclose(model.predict_rotations(window[:, [6, 1, 2, 3, 4, 5, 0]]), found, atol=1e-3)
