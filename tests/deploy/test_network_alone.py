"""A network alone computes what the network does, with less around it."""

import pytest
import tiny
import torch

from memmlp.deploy.latency import macs
from memmlp.deploy.network_alone import NoConversion, network_alone
from memmlp.motion.body import POSITION, ROTATION, SPARSE_DIM
from memmlp.motion.network_coordinates import Heading, World
from memmlp.motion.normalizer import Normalizer

NETWORKS = {
    **{name: lambda name=name: tiny.baseline(name) for name in tiny.BASELINES},
    "mem_mlp": tiny.model,
    "recurrent_poser": tiny.recurrent_poser,
    "refined": tiny.refined,
}


@pytest.mark.parametrize("name", NETWORKS)
@torch.no_grad()
def test_without_conversions_it_is_the_same_network(name):
    """In the world's coordinates, without z-scores, features are the world's inputs."""
    model = NETWORKS[name]()
    for module in model.modules():
        if isinstance(module, Normalizer):
            module.coordinates = World()
            module.mean.zero_(), module.std.fill_(1)
    alone = network_alone(model)
    clip = tiny.clip(4)[None, :, :SPARSE_DIM]
    ours, theirs = model.initial_state(), alone.initial_state()
    for t in range(clip.shape[1]):
        whole, ours = model.advance(clip[:, t : t + 1], ours, 1)
        bare, theirs = alone.advance(clip[:, t : t + 1], theirs, 1)
        torch.testing.assert_close(bare[..., ROTATION], whole[..., ROTATION], atol=1e-5, rtol=1e-5)
    assert macs(alone) <= macs(model)


@torch.no_grad()
def test_rotations_of_the_world_stay_as_members_make_them():
    """What follows from them, rotations in the parents' frames and positions, is kinematics."""
    model = tiny.recurrent_poser(Heading(), output="global", members=2)
    alone, x = network_alone(model), torch.randn(1, 1, SPARSE_DIM)
    made, _ = alone.advance(x, alone.initial_state(), 1)
    members = [one(x, one.initial_state(x, 1), 1)[0] for _, one in model.named_members()]
    torch.testing.assert_close(made[..., ROTATION], sum(members) / 2)
    assert (made[..., POSITION] == 0).all()


@torch.no_grad()
def test_a_refiner_alone_has_no_kinematics():
    alone = network_alone(tiny.refined(tiny.baseline("avatar_poser")))
    made, _ = alone.advance(torch.randn(1, 1, SPARSE_DIM), alone.initial_state(), 1)
    assert (made[..., POSITION] == 0).all()


@torch.no_grad()
def test_neither_conversion_nor_kinematics_are_left():
    model = tiny.baseline("avatar_poser")
    alone = network_alone(model)
    window = torch.randn(1, 7, SPARSE_DIM)
    made, _ = alone.advance(window, alone.initial_state(), 1)
    torch.testing.assert_close(made[0, :, ROTATION], model.rotations(window))
    assert (made[..., POSITION] == 0).all()
    assert isinstance(alone.normalizer, NoConversion)
    assert not isinstance(model.normalizer, NoConversion)
