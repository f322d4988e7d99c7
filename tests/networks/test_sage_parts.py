"""SAGE-Net's networks: published sizes, shapes, the quantiser."""

import numpy as np
import pytest
import torch

from memmlp.networks import sage_parts
from memmlp.networks.layers import find_batch_dependent

SIZES = {
    "upper codes": (lambda: sage_parts.HalfVQVAE(sage_parts.UPPER), 7_239_436),
    "lower codes": (lambda: sage_parts.HalfVQVAE(sage_parts.LOWER), 7_200_986),
    "upper diffusion": (sage_parts.UpperDenoiser, 57_969_432),
    "lower diffusion": (sage_parts.LowerDenoiser, 58_264_728),
    "decoder": (sage_parts.Decoder, 4_035_374),
}


@pytest.mark.parametrize("name", SIZES)
def test_published_sizes(name):
    make, count = SIZES[name]
    with torch.device("meta"):
        assert sum(p.numel() for p in make().parameters()) == count


def test_table_16_counts_diffusion_and_decoder():
    assert sum(SIZES[name][1] for name in ("upper diffusion", "lower diffusion", "decoder")) == 120_269_534


@torch.no_grad()
def test_the_way_of_a_window():
    x, rotation = torch.randn(2, 20, 54), torch.randn(2, 20, 132)
    small = {"width": 16, "depth": 1, "heads": 2}
    codes = [sage_parts.HalfVQVAE(joints, **small).eval() for joints in (sage_parts.UPPER, sage_parts.LOWER)]
    (upper, _), (lower, _) = (one.encode(rotation, x) for one in codes)
    assert [tuple(one.decode(z).shape) for one, z in zip(codes, (upper, lower), strict=True)] == [
        (2, 20, 84),
        (2, 20, 54),
    ]
    time = torch.tensor([3, 5])
    assert sage_parts.UpperDenoiser(**small)(upper, time, x).shape == (2, 10, 384)
    denoiser = sage_parts.LowerDenoiser(**small)
    assert denoiser(denoiser.join(lower, upper), time, x).shape == (2, 10, 384)
    assert sage_parts.Decoder(**small)(upper, lower, x).shape == (2, 20, 132)
    assert sorted({*sage_parts.UPPER, *sage_parts.LOWER}) == list(range(22))


@torch.no_grad()
def test_the_nearest_code_of_each_book_stands_for_its_part():
    quantiser, z = sage_parts.ProductQuantiser().eval(), torch.randn(2, 5, 384)
    found, loss = quantiser(z)
    expected = np.zeros((10, 384), dtype=np.float32)
    for row, latent in enumerate(z.flatten(0, 1).numpy()):
        for book in range(8):
            part, vectors = slice(48 * book, 48 * book + 48), quantiser.vectors[book].numpy()
            expected[row, part] = vectors[((vectors - latent[part]) ** 2).sum(-1).argmin()]
    np.testing.assert_allclose(found.flatten(0, 1).numpy(), expected, atol=1e-5)
    assert float(loss) == pytest.approx(
        2 * float(((z.flatten(0, 1).numpy() - expected) ** 2).mean()), rel=1e-4
    )


def test_codes_that_nothing_uses_come_alive_and_gradients_pass_straight_through():
    quantiser, z = sage_parts.ProductQuantiser(), (10 + torch.randn(4, 16, 384)).requires_grad_()
    before = quantiser.vectors.detach().clone()
    found, loss = quantiser(z)
    found.sum().backward(retain_graph=True)
    assert torch.equal(z.grad, torch.ones_like(z))
    assert float((quantiser.vectors - before).detach().norm(dim=-1).median()) > 10
    loss.backward()
    assert quantiser.vectors.grad.any()


def test_several_processes_would_count_codes_each_by_itself():
    small = {"width": 16, "depth": 1, "heads": 2}
    assert find_batch_dependent(sage_parts.HalfVQVAE(sage_parts.LOWER, **small)) == ["ProductQuantiser"]
    assert find_batch_dependent(sage_parts.LowerDenoiser(**small)) == []
