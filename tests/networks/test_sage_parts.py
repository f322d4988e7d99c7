"""SAGE-Net's networks: published sizes, shapes, the quantiser."""

import copy

import pytest
import torch

from memmlp.networks import sage_parts
from memmlp.networks.layers import find_batch_dependent_layers
from memmlp.networks.sage_net import SAGESettings

PAPER = SAGESettings(20, 512, 12, 8, 256, 4, 4)
SMALL = SAGESettings(20, 16, 1, 2, 16, 1, 2)


def test_published_sizes():
    """Table 16 counts both diffusion models and the decoder."""
    with torch.device("meta"):
        made = [sage_parts.HalfVQVAE(half, PAPER) for half in (sage_parts.UPPER, sage_parts.LOWER)]
        made += [getattr(sage_parts, name)(PAPER) for name in ("UpperDenoiser", "LowerDenoiser", "Decoder")]
    sizes = [sum(p.numel() for p in part.parameters()) for part in made]
    assert sizes == [7_239_436, 7_200_986, 57_969_432, 58_264_728, 4_035_374]
    assert find_batch_dependent_layers(sage_parts.HalfVQVAE(sage_parts.LOWER, SMALL)) == ["ProductQuantiser"]
    assert find_batch_dependent_layers(sage_parts.LowerDenoiser(SMALL)) == []


@torch.no_grad()
def test_the_nearest_code_of_each_book_stands_for_its_part():
    quantiser, z = sage_parts.ProductQuantiser().eval(), torch.randn(2, 5, 384)
    found, loss = quantiser(z)
    books = z.unflatten(-1, (8, 48)).flatten(0, 1).transpose(0, 1)  # (8, 10, 48)
    nearest = torch.cdist(books, quantiser.vectors).argmin(-1)
    expected = torch.stack([vectors[row] for vectors, row in zip(quantiser.vectors, nearest, strict=True)], 1)
    torch.testing.assert_close(found, expected.reshape(z.shape), atol=1e-5, rtol=0)
    assert float(loss) == pytest.approx(2 * float((z - expected.reshape(z.shape)).square().mean()), rel=1e-4)


def test_codes_that_nothing_uses_come_alive_and_gradients_pass_straight_through():
    quantiser, z = sage_parts.ProductQuantiser(), (10 + torch.randn(4, 16, 384)).requires_grad_()
    before = quantiser.vectors.detach().clone()
    found, loss = quantiser(z)
    found.sum().backward(retain_graph=True)
    assert torch.equal(z.grad, torch.ones_like(z))
    assert float((quantiser.vectors - before).detach().norm(dim=-1).median()) > 10
    loss.backward()
    assert quantiser.vectors.grad.any()


def test_gradients_are_those_of_the_codes_before_they_move():
    quantiser, z = sage_parts.ProductQuantiser(), (0.02 * torch.randn(4, 16, 384)).requires_grad_()
    unmoved = copy.deepcopy(quantiser)
    unmoved.move_unused_codes = lambda *_: None
    (found,), (expected,) = (torch.autograd.grad(one(z)[1], z) for one in (quantiser, unmoved))
    torch.testing.assert_close(found, expected)
