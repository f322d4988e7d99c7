"""AvatarPoser, part by part."""

import tiny
import torch

from memmlp.evaluation import modes as evaluation
from memmlp.motion.body import SPARSE_DIM

CLIP = tiny.clip(40)
SPARSE = CLIP[None, :, :SPARSE_DIM]


@torch.no_grad()
def test_avatar_poser_is_the_same_in_both_modes():
    """Every frame has its own window, so a clip of whole windows is the same in both."""
    model = tiny.baseline("avatar_poser")
    clip = CLIP[: 5 * model.frames]
    torch.testing.assert_close(evaluation.window(model, [clip])[0], evaluation.stream(model, [clip])[0])


@torch.no_grad()
def test_avatar_poser_reads_the_newest_frame_and_knows_no_order_of_the_others():
    model, window = tiny.baseline("avatar_poser").double(), torch.randn(1, 7, SPARSE_DIM).double()
    found = model.predict_rotations(window)
    torch.testing.assert_close(model.predict_rotations(window[:, [3, 1, 5, 0, 2, 4, 6]]), found)
    assert not torch.allclose(model.predict_rotations(window[:, [6, 1, 2, 3, 4, 5, 0]]), found, atol=1e-3)


def test_dropout_drops_in_training_alone():
    model = tiny.baseline("avatar_poser", dropout=0.5)
    call = SPARSE[:, :7], model.initial_state(1), CLIP[None, :7]
    assert torch.equal(model.training_call(*call)[0], model.training_call(*call)[0])
    model.train()
    assert not torch.equal(model.training_call(*call)[0], model.training_call(*call)[0])
