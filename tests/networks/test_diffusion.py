"""The schedule of noise and DDIM, computed independently."""

import numpy as np
import pytest
import torch

from memmlp.networks.diffusion import Diffusion, cosine_schedule


def test_cosine_schedule_is_the_papers():
    signal = cosine_schedule(1000).numpy()
    level = np.cos((np.arange(1001) / 1000 + 0.008) / 1.008 * np.pi / 2) ** 2
    np.testing.assert_allclose(signal[:-1], (level / level[0])[1:-1], rtol=1e-9)
    assert signal[-1] == pytest.approx(signal[-2] * 0.001)


@pytest.mark.parametrize("steps", [1, 3, 5])
def test_ddim_is_an_independent_numpy_computation(steps):
    """The denoiser is an affine map of the noisy signal and the time."""
    diffusion = Diffusion(20, steps).double()
    noise = np.random.default_rng(0).normal(size=(2, 4, 3))
    found = diffusion.sample(lambda x, t: 0.7 * x + 0.1 + 0.01 * t[:, None, None], torch.tensor(noise))
    betas = [
        min(1 - np.cos(((i + 1) / 20 + 0.008) / 1.008 * np.pi / 2) ** 2 /
            np.cos((i / 20 + 0.008) / 1.008 * np.pi / 2) ** 2, 0.999)
        for i in range(20)
    ]  # fmt: skip
    alphas = np.cumprod(1 - np.array(betas))
    x, times = noise, [20 * k // steps - 1 for k in range(steps, 0, -1)]
    for origin, t in enumerate(times):
        clean = 0.7 * x + 0.1 + 0.01 * t
        epsilon = (x - np.sqrt(alphas[t]) * clean) / np.sqrt(1 - alphas[t])
        after = alphas[times[origin + 1]] if origin + 1 < steps else 1.0
        x = np.sqrt(after) * clean + np.sqrt(1 - after) * epsilon
    assert times[0] == 19
    np.testing.assert_allclose(found.numpy(), x, atol=1e-5)


def test_training_noise_has_the_schedules_variance():
    diffusion = Diffusion(10, 2)
    clean, noise = torch.full((10, 3), 2.0), torch.full((10, 3), 0.5)
    noisy = diffusion.add_noise(clean, torch.arange(10), noise).numpy()
    signal = cosine_schedule(10).numpy()
    expected = (np.sqrt(signal) * 2 + np.sqrt(1 - signal) * 0.5)[:, None].repeat(3, 1)
    np.testing.assert_allclose(noisy, expected, rtol=1e-5)


def test_a_perfect_denoiser_is_found_again():
    """Whatever the noise and the steps, a denoiser that knows the answer gives it."""
    answer = torch.randn(2, 5)
    torch.testing.assert_close(Diffusion(50, 4).sample(lambda x, t: answer, torch.randn(2, 5)), answer)
