"""The schedule of noise and DDIM, computed independently."""

import math

import numpy as np
import pytest
import torch
from torch.distributions import Normal, kl_divergence

from memmlp.networks import diffusion as module
from memmlp.networks.diffusion import (
    AncestralDiffusion,
    DenoiserOutput,
    Diffusion,
    ReleasedAncestralDiffusion,
)


@pytest.mark.parametrize("steps", [1, 3, 5])
def test_ddim_is_an_independent_numpy_computation(steps):
    """The denoiser is an affine map of the noisy signal and the time."""
    diffusion = Diffusion(20, steps).double()
    noise = np.random.default_rng(0).normal(size=(2, 4, 3))
    found = diffusion.sample(lambda x, i: 0.7 * x + 0.1 + 0.01 * diffusion.times[i], torch.tensor(noise))
    level = np.cos((np.arange(21) / 20 + 0.008) / 1.008 * np.pi / 2) ** 2
    betas = np.minimum(1 - level[1:] / level[:-1], 0.999)
    alphas = np.cumprod(1 - betas)
    x, times = noise, [20 * k // steps - 1 for k in range(steps, 0, -1)]
    for origin, t in enumerate(times):
        clean = 0.7 * x + 0.1 + 0.01 * t
        epsilon = (x - np.sqrt(alphas[t]) * clean) / np.sqrt(1 - alphas[t])
        after = alphas[times[origin + 1]] if origin + 1 < steps else 1.0
        x = np.sqrt(after) * clean + np.sqrt(1 - after) * epsilon
    assert times[0] == 19
    np.testing.assert_allclose(found.numpy(), x, atol=1e-5)


OPEN = torch.tensor(-9.0), torch.tensor(9.0)


def tables(kept: np.ndarray) -> tuple[np.ndarray, ...]:
    """Coefficients of the clean and of the noisy signal, least and largest variance, by step."""
    before = np.append(1.0, kept[:-1])
    added = 1 - kept / before
    least = added * (1 - before) / (1 - kept)
    least[0] = least[1]
    clean = np.sqrt(before) * added / (1 - kept)
    return clean, np.sqrt(1 - added) * (1 - before) / (1 - kept), least, added


def kept(steps: int) -> np.ndarray:
    """Signal's share of the variance."""
    return np.cumprod(1 - np.linspace(0.1 / steps, 20 / steps, steps))


def test_the_linear_schedule_is_the_papers():
    np.testing.assert_allclose(module.make_linear_schedule(1000).numpy(), kept(1000), rtol=1e-9)
    assert torch.all(module.make_linear_schedule(5).diff() < 0)
    assert torch.all(module.make_linear_schedule(5) > 0)


def made(noisy: torch.Tensor, time: torch.Tensor) -> DenoiserOutput:
    """An affine map of the noisy signal and the time."""
    return DenoiserOutput(0.7 * noisy + 0.01 * time.view(-1, 1, 1), 0.1 * noisy - 0.3)


@pytest.mark.parametrize(("released", "count"), [(0, 1), (0, 4), (0, 53), (1, 4), (1, 53)])
def test_sampling_is_an_independent_numpy_computation(released, count):
    """Estimates are kept within limits but for the last; noise is added but at the end and below time 50. As
    released, all estimates are kept within limits, and the last 49 steps add no noise."""
    kind = ReleasedAncestralDiffusion if released else AncestralDiffusion
    diffusion, rng = kind(60, count).double(), np.random.default_rng(0)
    noise = rng.normal(size=(diffusion.noise_draws, 2, 4, 3))
    limits = torch.tensor(-2.0), torch.tensor(-1.0)

    def step(x: torch.Tensor, index: int) -> tuple[torch.Tensor, torch.Tensor]:
        times = torch.full((2,), diffusion.times[index])
        mean, variance = diffusion.step(x, made(x, times), index, limits)
        return mean, variance.sqrt()

    found = diffusion.sample(step, torch.tensor(noise))
    times = [round(59 * k / count) if released else 60 * (k + 1) // count - 1 for k in range(count)]
    first, second, least, largest = tables(kept(60)[times]) if count > 1 else (np.ones(1), *np.zeros((3, 1)))
    x = noise[0]
    for i, t in reversed(list(enumerate(times))):
        clean = (x - np.sqrt(1 - kept(60)[t]) * (0.7 * x + 0.01 * t)) / np.sqrt(kept(60)[t])
        share = (0.1 * x - 0.3 + 1) / 2
        x = first[i] * (np.clip(clean, -2, -1) if i or released else clean) + second[i] * x
        if i >= 49 if released else i and t >= 50:
            x = x + np.sqrt(largest[i] ** share * least[i] ** (1 - share)) * noise[count - i]
    assert len(noise) == ({4: 1, 53: 5} if released else {1: 1, 4: 2, 53: 9})[count]
    np.testing.assert_allclose(found.numpy(), x, atol=1e-4)


def test_the_released_times_are_a_rounded_running_sum_without_its_last():
    """Of the respacing to 5 times, 0, 250, 500, 749 and 999, and of longer ones."""
    for count in (4, 9, 20, 24):
        sums = [0.0]
        while len(sums) < count:
            sums.append(sums[-1] + 999 / count)
        assert ReleasedAncestralDiffusion(1000, count).times[::-1] == [round(one) for one in sums]
    assert ReleasedAncestralDiffusion(1000, 4).times == [749, 500, 250, 0]
    assert ReleasedAncestralDiffusion(1000, 20).times[9] == 499  # not 500
    assert ReleasedAncestralDiffusion(1000, 999).times == list(range(999))[::-1]


def test_the_losses_are_an_independent_numpy_computation():
    """Beyond the first step the bound is the divergence of two Gaussians."""
    diffusion, draw = AncestralDiffusion(20, 2).double(), torch.Generator().manual_seed(0)
    clean, noise = (torch.randn(3, 1, 1, generator=draw).double() for _ in range(2))
    time = torch.tensor([19, 7, 2])
    noisy = diffusion.add_noise(clean, time, noise)
    guess = DenoiserOutput(*(part.requires_grad_() for part in made(noisy, time)))
    error, bound = diffusion.compute_losses(clean, noise, time, guess, OPEN)
    first, second, least, largest = (table[time][:, None, None] for table in tables(kept(20)))
    share = (guess.variance_fraction.detach().numpy() + 1) / 2
    rest = diffusion.remove_noise(noisy, guess.noise, time).detach()
    means = [torch.from_numpy(first * of.numpy() + second * noisy.numpy()) for of in (clean, rest)]
    deviations = [torch.from_numpy(np.sqrt(of)) for of in (least, largest**share * least ** (1 - share))]
    true, found = (Normal(mean, deviation) for mean, deviation in zip(means, deviations, strict=True))
    expected = kl_divergence(true, found).numpy()
    assert float(bound.detach()) == pytest.approx(expected.mean() / math.log(2), rel=1e-3)
    assert float(error.detach()) == pytest.approx(float((noise - guess.noise.detach()).square().mean()))
    bound.backward()
    assert guess.noise.grad is None  # the variances alone learn from it
    assert guess.variance_fraction.grad.all()
