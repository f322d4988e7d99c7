"""AvatarJLM, part by part."""

import tiny
import torch

from memmlp.motion.body import ROTATION, SPARSE_DIM
from memmlp.networks import avatar_jlm

TRUTH = torch.stack([tiny.clip(7, seed) for seed in (1, 2)])
SPARSE = TRUTH[..., :SPARSE_DIM]


@torch.no_grad()
def test_tracked_joints_stand_in_the_tokens_as_they_are():
    """The head is the origin, hands and rotations are the trackers'; all others are the coarse pose's."""
    model, sparse, seen = tiny.baseline("avatar_jlm").double(), SPARSE.double(), {}
    model.position_token.register_forward_hook(lambda _, given, made: seen.update(position=given[0]))
    model.rotation_token.register_forward_hook(lambda _, given, made: seen.update(rotation=given[0]))
    encoded = model.normalizer.encode_sparse(sparse, model.normalizer.find_origin(sparse))
    model.make_tokens(encoded)
    expected = model.place_coarse_joints(model.embedding(avatar_jlm.spread_over_joints(encoded)))
    places = sparse[..., 36:45].unflatten(-1, (3, 3))
    tracked = places - places[..., :1, :], sparse[..., :18].unflatten(-1, (3, 6))
    for found, coarse, true in zip(seen.values(), expected, tracked, strict=True):
        torch.testing.assert_close(found[..., [15, 20, 21], :], true)
        others = [joint for joint in range(22) if joint not in (15, 20, 21)]
        torch.testing.assert_close(found[..., others, :], coarse[..., others, :])


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
    assert float(made.losses["coarse"]) == float(model.compute_coarse_loss(truth)["coarse"]) > 0.1
