"""AvatarJLM, part by part."""

import tiny
import torch

from memmlp.motion.body import ROTATION, SPARSE_DIM

TRUTH = torch.stack([tiny.clip(7, seed) for seed in (1, 2)])
SPARSE = TRUTH[..., :SPARSE_DIM]


def test_the_inputs_token_teaches_the_embedding_nothing():
    model = tiny.baseline("avatar_jlm")
    encoded = model.normalizer.encode_sparse(SPARSE, model.normalizer.find_origin(SPARSE))
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
