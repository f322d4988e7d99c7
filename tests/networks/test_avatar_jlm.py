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
    model = tiny.baseline("avatar_jlm").double()
    seen = {}
    model.position_token.register_forward_hook(lambda _, given, made: seen.update(position=given[0]))
    model.rotation_token.register_forward_hook(lambda _, given, made: seen.update(rotation=given[0]))
    encoded = model.normalizer.encode_sparse(SPARSE.double(), model.normalizer.find_origin(SPARSE.double()))
    model.make_tokens(encoded)
    joints, turns = model.place_coarse_joints(model.embedding(avatar_jlm.spread_over_joints(encoded)))
    true = SPARSE[..., 36:45].unflatten(-1, (3, 3)).double()
    torch.testing.assert_close(seen["position"][..., [15, 20, 21], :], true - true[..., :1, :])
    torch.testing.assert_close(
        seen["rotation"][..., [15, 20, 21], :], SPARSE[..., :18].unflatten(-1, (3, 6)).double()
    )
    others = [joint for joint in range(22) if joint not in (15, 20, 21)]
    torch.testing.assert_close(seen["position"][..., others, :], joints[..., others, :])
    torch.testing.assert_close(seen["rotation"][..., others, :], turns[..., others, :])


def test_the_inputs_token_is_renewed_and_teaches_the_embedding_nothing():
    model, seen = tiny.baseline("avatar_jlm"), []
    for layer in model.layers:
        layer.register_forward_hook(lambda _, given, made: seen.append(given[0]))
    encoded = model.normalizer.encode_sparse(SPARSE, model.normalizer.find_origin(SPARSE))
    model.predict_rotations(encoded)
    first = seen[0].unflatten(0, (2, 7))[:, :, -1]
    for index, h in enumerate(seen):
        shape = (2, 7) if index % 2 == 0 else (2, avatar_jlm.TOKENS)
        tokens = h.unflatten(0, shape)
        torch.testing.assert_close(tokens[:, :, -1] if index % 2 == 0 else tokens[:, -1], first)
    model.make_tokens(encoded)[..., -1, :].sum().backward()
    slope = model.embedding.weight.grad
    assert model.input_token.weight.grad.any()
    assert slope is None or not slope.any()


class Always(torch.nn.Module):
    """The same, whatever is asked."""

    def __init__(self, made: torch.Tensor):
        super().__init__()
        self.made = made

    def forward(self, _: torch.Tensor) -> torch.Tensor:
        return self.made


@torch.no_grad()
def test_the_coarse_poses_loss_is_of_joints_relative_to_the_head():
    """With the true rotations as the coarse pose it is nothing."""
    model = tiny.baseline("avatar_jlm", coarse_weight=2.0).double()
    truth = TRUTH.double()
    true = model.normalizer.encode(truth)[..., SPARSE_DIM:][..., ROTATION]
    coarse = model.coarse
    model.coarse = Always(true)
    assert float(model.compute_coarse_loss(truth)["coarse"]) < 1e-6
    model.coarse = coarse
    found = model.compute_training_outputs(
        truth[:, -1:, :SPARSE_DIM], model.true_state(truth[:, :-1]), truth
    ).losses["coarse"]
    assert float(found) == float(model.compute_coarse_loss(truth)["coarse"]) > 0.1
