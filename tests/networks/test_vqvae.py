"""The code-vector model: nearest codes, learning, restarts."""

import pytest
import tiny
import torch

from memmlp.motion.body import FRAME_DIM
from memmlp.networks.vqvae import VQVAE, EMACodebook, GradientCodebook


def test_the_nearest_code_is_chosen():
    book = tiny.vqvae().codebook
    latent = torch.randn(5, 3, 12)
    vectors, index = book(latent)
    brute = ((latent[..., None, :] - book.vectors) ** 2).sum(-1).argmin(-1)
    assert torch.equal(index, brute)
    assert torch.equal(vectors, book.vectors[brute])


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
        vectors = model.code_vectors(frames[:, :54], frames[:, 54:])
        indices = model.codebook.find_indices(latent)
    assert torch.equal(vectors, model.code_vectors(frames[:, :54], frames[:, 54:]))
    assert torch.equal(indices, model.codebook.find_indices(latent))


def learned(codebook: str, steps: int = 150) -> tuple[float, float, int]:
    torch.manual_seed(0)
    model = VQVAE(codes=8, width=12, encoder_depth=1, codebook=codebook)
    optimiser = torch.optim.Adam(model.parameters(), lr=3e-3)
    data = torch.randn(6, FRAME_DIM)[torch.randint(6, (64,))] + 0.05 * torch.randn(64, FRAME_DIM)
    errors = []
    for _ in range(steps):
        rotations, quantised = model.reconstruct(data)
        error = (rotations - data[:, 54:186]).abs().mean()
        optimiser.zero_grad()
        (error + quantised.loss).backward()
        optimiser.step()
        errors.append(float(error.detach()))
    return errors[0], errors[-1], len(quantised.indices.unique())


@pytest.mark.parametrize("codebook", ["ema", "gradient"])
def test_it_learns(codebook):
    first, last, used = learned(codebook)
    assert last < 0.7 * first
    assert used >= (4 if codebook == "ema" else 1)


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


def test_decay_and_depths_change_it():
    def codes(decay: float) -> torch.Tensor:
        torch.manual_seed(0)
        book = EMACodebook(codes=3, width=2, commitment=0.25, decay=decay)
        for _ in range(3):
            book.learn(torch.randn(30, 2))
        return book.vectors

    assert not torch.allclose(codes(0.5), codes(0.99))
    models = [VQVAE(encoder_depth=e, decoder_depth=d) for e, d in ((2, 1), (4, 1), (4, 2))]
    sizes = {sum(p.numel() for p in model.parameters()) for model in models}
    assert len(sizes) == 3
    assert isinstance(VQVAE(codebook="gradient").codebook, GradientCodebook)
