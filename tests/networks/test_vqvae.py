"""The code-vector model: nearest codes, learning, restarts."""

import pytest
import torch

from memmlp.motion.body import FRAME_DIM
from memmlp.networks.vqvae import VQVAE, EMACodebook


@pytest.mark.parametrize("codebook", ["ema", "gradient"])
@torch.no_grad()
def test_a_mixed_precision_training_finds_the_code_vectors_that_evaluation_finds(codebook):
    """Each code-vector is some frame's latent, so that many frames are almost as near to two of them."""
    torch.manual_seed(3)
    model = VQVAE(codes=64, width=12, encoder_depth=2, codebook=codebook).eval()
    frames = torch.randn(4000, FRAME_DIM)
    latent = model.encoder(frames)
    model.codebook.vectors.copy_(latent[:64])
    with torch.autocast("cpu", torch.bfloat16):
        vectors = model.compute_code_vectors(frames[:, :54], frames[:, 54:])
        indices = model.codebook.find_indices(latent)
    assert torch.equal(vectors, model.compute_code_vectors(frames[:, :54], frames[:, 54:]))
    assert torch.equal(indices, model.codebook.find_indices(latent))


def test_running_means_find_the_clusters():
    torch.manual_seed(0)
    book = EMACodebook(codes=3, width=2, commitment=0.25, decay=0.8)
    centres = torch.tensor([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])
    for _ in range(200):
        book.learn(centres[torch.randint(3, (60,))] + 0.01 * torch.randn(60, 2))
    order = (book.vectors @ torch.tensor([1.0, 2.0])).argsort()
    torch.testing.assert_close(book.vectors[order], centres, atol=0.05, rtol=0)


def test_a_dead_code_is_restarted_on_data():
    torch.manual_seed(0)
    book = EMACodebook(codes=4, width=2, commitment=0.25, decay=0.5)
    book.learn(torch.randn(50, 2))
    with torch.no_grad():
        book.vectors[0] = book.sums[0] = 1e3
        book.counts[0] = 1.0
    for _ in range(20):
        book.learn(torch.randn(50, 2))
    assert book.vectors.abs().max() < 10


def test_straight_through_reaches_the_encoder_and_commitment_counts():
    def gradient(commitment: float) -> torch.Tensor:
        torch.manual_seed(0)
        model = VQVAE(codes=4, width=6, encoder_depth=1, commitment=commitment)
        rotations, quantised = model.reconstruct(torch.randn(9, FRAME_DIM))
        (rotations.abs().sum() + quantised.loss).backward()
        return model.encoder[0].weight.grad

    assert gradient(0.0).abs().sum() > 0
    assert not torch.allclose(gradient(0.0), gradient(5.0))
