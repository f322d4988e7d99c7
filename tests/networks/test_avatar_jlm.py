"""AvatarJLM, part by part."""

import tiny
import torch

from memmlp.motion.body import ROTATION, SPARSE_DIM
from memmlp.networks import avatar_jlm

TRUTH = torch.stack([tiny.clip(7, seed) for seed in (1, 2)])
SPARSE = TRUTH[..., :SPARSE_DIM]


def test_the_inputs_token_is_renewed_and_teaches_the_embedding_nothing():
    model, seen = tiny.baseline("avatar_jlm"), []
    for layer in model.layers:
        layer.register_forward_hook(lambda _, given, made: seen.append(given[0]))
    encoded = model.normalizer.encode_sparse(SPARSE, model.normalizer.find_origin(SPARSE))
    model.predict_rotations(encoded)
    first = seen[0].unflatten(0, (2, 7))[:, :, -1]
    for over_joints, over_frames in zip(seen[::2], seen[1::2], strict=True):
        torch.testing.assert_close(over_joints.unflatten(0, (2, 7))[:, :, -1], first)
        torch.testing.assert_close(over_frames.unflatten(0, (2, avatar_jlm.TOKENS))[:, -1], first)
    model.make_tokens(encoded)[..., -1, :].sum().backward()
    slope = model.embedding.weight.grad
    assert model.input_token.weight.grad.any()
    assert slope is None or not slope.any()


@torch.no_grad()
def test_the_coarse_poses_loss_is_of_joints_relative_to_the_head():
    """With the true rotations as the coarse pose it is nothing."""
    model, truth = tiny.baseline("avatar_jlm", coarse_weight=2.0).double(), TRUTH.double()
    model.coarse.forward = lambda _: model.normalizer.encode(truth)[..., SPARSE_DIM:][..., ROTATION]
    assert float(model.compute_coarse_loss(truth)["coarse"]) < 1e-6
    del model.coarse.forward
    made = model.compute_training_outputs(truth[:, -1:, :SPARSE_DIM], model.true_state(truth[:, :-1]), truth)
    assert float(made.losses["coarse"]) == (every := float(model.compute_coarse_loss(truth)["coarse"])) > 0.1
    model.coarse_untracked = True  # three joints of 22 count as exact
    assert 0 < float(model.compute_coarse_loss(truth)["coarse"]) < every
