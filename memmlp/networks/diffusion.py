"""Denoising diffusion: noise schedules, noise for training signals, and sampling."""

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import accumulate, repeat
from typing import NamedTuple

import torch
from torch import Tensor, nn

from memmlp.common import distributed
from memmlp.networks.settings import make_strided_times

Denoise = Callable[[Tensor, int], Tensor]
"""Maps a noisy signal (B, ...) at a sampling step to an estimate of the clean signal."""


def make_cosine_schedule(steps: int) -> Tensor:
    """Return the cosine schedule (steps,), float64; see `signal` in NoiseProcess.

    This is Eq. 17 of Nichol & Dhariwal 2021. The noise of one step has a variance fraction of at most 0.999.
    """
    offset = 0.008
    time = torch.arange(steps + 1, dtype=torch.float64) / steps
    level = ((time + offset) / (1 + offset) * math.pi / 2).cos().square()
    kept = (level[1:] / level[:-1]).clamp_min(1 - 0.999)
    return kept.cumprod(0)


def make_linear_schedule(steps: int) -> Tensor:
    """Return the linear schedule (steps,), float64; see `signal` in NoiseProcess.

    The variance fraction of one step's noise grows linearly from 1e-4 to 0.02 over 1000 steps (Ho et al.
    2020, Sec. 4). With fewer steps each step adds proportionally more noise, at most 0.999.
    """
    added = torch.linspace(1e-4, 0.02, steps, dtype=torch.float64) * (1000 / steps)
    return (1 - added.clamp_max(0.999)).cumprod(0)


class NoiseProcess(nn.Module):
    """The noise process: adds noise to training signals, and defines the sampling times.

    Args:
        signal: at each diffusion time, the fraction (steps,) of a noisy signal's variance that is due to
            the clean signal.
        sampling_steps: number of sampling times; see `space_times`.
    """

    signal: Tensor

    def __init__(self, signal: Tensor, sampling_steps: int):
        super().__init__()
        self.steps = len(signal)
        self.times = self.space_times(sampling_steps)
        self.register_buffer("signal", signal.float(), persistent=False)

    def space_times(self, count: int) -> list[int]:
        """Return `count` sampling times, the noisiest first.

        They are evenly spaced and start at the schedule's last step, pure noise (Song et al. 2021, App. D.2:
        linear).
        """
        return [self.steps * (i + 1) // count - 1 for i in reversed(range(count))]

    def find_times(self, index: int, noisy: Tensor) -> Tensor:
        """Return the diffusion times (B,) of noisy signals (B, ...) at sampling step `index`, from 0."""
        return torch.full((len(noisy),), self.times[index], device=noisy.device)

    def draw_times(self, clean: Tensor) -> Tensor:
        """Draw a time (B,) for each signal of a batch (B, ...)."""
        return torch.randint(self.steps, (len(clean),), device=clean.device)

    def add_noise(self, clean: Tensor, time: Tensor, noise: Tensor) -> Tensor:
        """Mix clean signals (B, ...) with standard normal noise (B, ...), according to the times (B,)."""
        signal = look_up_at_times(self.signal, time, clean)
        return signal.sqrt() * clean + (1 - signal).sqrt() * noise

    def draw_noisy(self, clean: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Draw times (B,) and noise (B, ...) for a training batch; return noisy signals, times and noise."""
        time = distributed.draw_rows(self.draw_times, clean)
        noise = distributed.draw_rows(torch.randn_like, clean)
        return self.add_noise(clean, time, noise), time, noise


def look_up_at_times(table: Tensor, time: Tensor, like: Tensor) -> Tensor:
    """Return a table's values at times (B,) as (..., B, 1, ...), which broadcasts to signals (B, ...)."""
    return table[..., time].unflatten(-1, (-1, *[1] * (like.dim() - 1)))


class Diffusion(NoiseProcess):
    """Diffusion with a cosine schedule and DDIM sampling; the network predicts the clean signal.

    Args:
        steps: number of steps of the noise schedule.
        sampling_steps: number of denoiser calls for a sample; see NoiseProcess.
    """

    def __init__(self, steps: int, sampling_steps: int):
        super().__init__(make_cosine_schedule(steps), sampling_steps)

    @property
    def calls(self) -> int:
        """The number of denoiser calls for a sample."""
        return len(self.times)

    @property
    def noise_draws(self) -> int:
        """The number of noise draws for a sample: one, for its start."""
        return 1

    def sample(self, denoise: Denoise, noise: Tensor, further: Sequence[Tensor] = ()) -> Tensor:
        """Sample the clean signal (B, ...) by deterministic DDIM (Song et al. 2021, Eq. 12, eta = 0).

        Args:
            denoise: maps a noisy signal (B, ...) and the index of a sampling step to an estimate of the clean
                signal.
            noise: the noise (B, ...) to start from.
            further: the noise of further draws (`noise_draws`), which broadcasts to the signal.
        """
        x = noise
        for index in range(self.calls):
            clean = denoise(x, index)
            is_last = index + 1 == len(self.times)
            x = clean if is_last else self.step(x, clean, index, further[index] if further else None)
        return x

    def step(self, x: Tensor, clean: Tensor, index: int, noise: Tensor | None = None) -> Tensor:
        """Take one sampling step.

        Args:
            x: the noisy signal (B, ...) at sampling step `index`.
            clean: the estimated clean signal for `x`.
            index: number of the sampling step, from 0.
            noise: the noise that the step adds; DDIM does not add noise.

        Returns:
            The noisy signal (B, ...) at sampling step `index` + 1.
        """
        here, there = (self.signal[time] for time in self.times[index : index + 2])
        direction = (x - here.sqrt() * clean) / (1 - here).sqrt()
        return there.sqrt() * clean + (1 - there).sqrt() * direction


class StridedDiffusion(Diffusion):
    """Diffusion with a cosine schedule and DDIM sampling as in SAGE-Net's released code.

    The sampling times are multiples of a stride and start below pure noise. A sample ends with the noisy
    signal at time 0. The released code calls the denoiser once more, without an effect on its sample.
    """

    def space_times(self, count: int) -> list[int]:
        return make_strided_times(self.steps, count)

    @property
    def calls(self) -> int:
        return len(self.times) - 1


class PosteriorDiffusion(Diffusion):
    """Diffusion with a cosine schedule, sampled as in AGRoL's released code.

    Each step draws from the posterior with the smallest variance (Ho et al. 2020, Eq. 7), the last step takes
    its mean. The sampling times are multiples of a stride and start below pure noise.
    """

    posterior: Tensor

    def __init__(self, steps: int, sampling_steps: int):
        super().__init__(steps, sampling_steps)
        posterior = compute_posterior(make_cosine_schedule(steps)[self.times[::-1]]).flip(-1)
        self.register_buffer("posterior", posterior.float(), persistent=False)

    def space_times(self, count: int) -> list[int]:
        return make_strided_times(self.steps, count)

    @property
    def noise_draws(self) -> int:
        """The number of noise draws for a sample: one for its start, one for each step except the last."""
        return len(self.times)

    def step(self, x: Tensor, clean: Tensor, index: int, noise: Tensor | None = None) -> Tensor:
        first, second, log_variance, _ = self.posterior[:, index]
        assert noise is not None
        return first * clean + second * x + (log_variance / 2).exp() * noise


SamplingStep = Callable[[Tensor, int], tuple[Tensor, Tensor]]
"""Maps a noisy signal and its sampling step to mean and standard deviation of the next signal."""
FIRST_NOISY_TIME = 50  # from this time of the noise schedule on a sample takes the mean
NOISELESS_CALLS = 49  # with which a sample ends in BoDiffusion's released code
BIN = 2 / 255  # the width of the bins of the first step's likelihood: a pixel's, as BoDiffusion's code has it


class DenoiserOutput(NamedTuple):
    """A denoiser's outputs for noisy signals (B, ...).

    Attributes:
        noise: the noise in the signals (B, ...).
        variance_fraction: position (B, ...) of a step's log variance between its limits: -1 at the smallest
            variance, 1 at the largest.
    """

    noise: Tensor
    variance_fraction: Tensor


def compute_posterior(signal: Tensor) -> Tensor:
    """Return mean coefficients and variances of the denoising steps (Ho et al. 2020, Eq. 7).

    Args:
        signal: the fraction (n,) of a noisy signal's variance that is due to the clean signal, at each
            diffusion time, float64.

    Returns:
        (4, n): coefficients of the clean and of the noisy signal in the mean, logarithms of the smallest and
        of the largest variance. The smallest variance at the first time would be 0, so the variance at the
        second time replaces it.
    """
    previous_signal = torch.cat([torch.ones_like(signal[:1]), signal[:-1]])
    largest = 1 - signal / previous_signal
    smallest = largest * (1 - previous_signal) / (1 - signal)
    smallest = torch.cat([smallest[1:2], smallest[1:]]) if len(signal) > 1 else largest
    clean = largest * previous_signal.sqrt() / (1 - signal)
    noisy = (1 - previous_signal) * (signal / previous_signal).sqrt() / (1 - signal)
    return torch.stack([clean, noisy, smallest.log(), largest.log()])


class AncestralDiffusion(NoiseProcess):
    """Diffusion with a linear schedule and ancestral sampling; the network predicts noise and variances.

    Args:
        steps: number of steps of the noise schedule.
        sampling_steps: number of denoiser calls for a sample; see NoiseProcess.
    """

    clamps_last_estimate = False
    trained: Tensor
    spaced: Tensor

    def __init__(self, steps: int, sampling_steps: int):
        signal = make_linear_schedule(steps)
        super().__init__(signal, sampling_steps)
        self.register_buffer("trained", compute_posterior(signal).float(), persistent=False)
        spaced = compute_posterior(signal[self.times[::-1]]).flip(-1)  # by sampling step: the noisiest first
        self.register_buffer("spaced", spaced.float(), persistent=False)

    @property
    def noise_draws(self) -> int:
        """The number of noise draws for a sample: one for its start, one for each step that adds noise.

        The last step and the steps within the last 50 times of the schedule do not add noise. A sample with
        few steps has hardly any such steps. Other steps need noise to sample from the learned distribution.
        """
        return 1 + sum(time >= FIRST_NOISY_TIME for time in self.times[:-1])

    def remove_noise(self, noisy: Tensor, noise: Tensor, time: Tensor) -> Tensor:
        """Return the clean signals (B, ...) of noisy signals with the given noise (B, ...) and times (B,)."""
        signal = look_up_at_times(self.signal, time, noisy)
        return (noisy - (1 - signal).sqrt() * noise) / signal.sqrt()

    def compute_losses(
        self,
        clean: Tensor,
        noise: Tensor,
        time: Tensor,
        predicted: DenoiserOutput,
        limits: tuple[Tensor, Tensor],
    ) -> tuple[Tensor, Tensor]:
        """Return the two terms of the hybrid loss, averaged over components (Nichol & Dhariwal 2021, Eq. 16).

        Args:
            clean: true signals (B, ...).
            noise: the noise (B, ...) in the noisy signals.
            time: the diffusion times (B,).
            predicted: the network's outputs for the noisy signals.
            limits: lower and upper limit of clean signals, broadcast to their shape.

        Returns:
            The mean squared error of the noise, and the variational bound in bits. The bound's gradient
            reaches only the variances.
        """
        noisy = self.add_noise(clean, time, noise)
        first, second, least, largest = look_up_at_times(self.trained, time, clean)
        predicted_mean = first * self.remove_noise(noisy, predicted.noise.detach(), time) + second * noisy
        true_mean = first * clean + second * noisy
        log_variance = least + (predicted.variance_fraction + 1) / 2 * (largest - least)
        spread = log_variance - least
        difference = (true_mean - predicted_mean).square() * (-log_variance).exp()
        divergence = (spread + (-spread).exp() + difference - 1) / 2
        last_step_loss = compute_negative_log_likelihood(clean, predicted_mean, log_variance, limits)
        bound = torch.where(time.view_as(first) == 0, last_step_loss, divergence)
        return (noise - predicted.noise).square().mean(), bound.mean() / math.log(2)

    def step(
        self, noisy: Tensor, predicted: DenoiserOutput, index: int, limits: tuple[Tensor, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Return mean and variance (B, ...) of the signal after a sampling step.

        The last step's estimate is clamped to the limits only as released: if the network has not learned a
        rotation, clamping could make the two columns of its 6D form parallel, which is not a rotation.

        Args:
            noisy: the noisy signal (B, ...) at sampling step `index`.
            predicted: the network's outputs for the noisy signal.
            index: number of the sampling step, from 0.
            limits: lower and upper limit for the estimated clean signal.
        """
        time = torch.full((1,), self.times[index], device=noisy.device)
        first, second, least, largest = self.spaced[:, index]
        clean = self.remove_noise(noisy, predicted.noise, time)
        if index + 1 < len(self.times) or self.clamps_last_estimate:
            clean = clean.clamp(*limits)
        mean = first * clean + second * noisy
        return mean, (least + (predicted.variance_fraction + 1) / 2 * (largest - least)).exp()

    def sample(self, step: SamplingStep, noise: Iterable[Tensor]) -> Tensor:
        """Sample a clean signal (...) with the given noise (...) of each draw (`noise_draws`)."""
        draws = iter(noise)
        x = next(draws)
        for index in range(len(self.times)):
            mean, deviation = step(x, index)
            further = next(draws, None)
            x = mean if further is None else mean + deviation * further
        return x


class ReleasedAncestralDiffusion(AncestralDiffusion):
    """Ancestral sampling as in BoDiffusion's released code.

    Its times are evenly spaced from the schedule's first to its last step. A sample starts at the second
    noisiest time, so the released code's respacing to N times has N - 1 denoiser calls. The last 49 calls do
    not add noise, whatever their times.
    """

    clamps_last_estimate = True

    def space_times(self, count: int) -> list[int]:
        stride = (self.steps - 1) / count  # the sum's rounding decides ties
        return [round(time) for time in accumulate(repeat(stride, count - 1), initial=0.0)][::-1]

    @property
    def noise_draws(self) -> int:
        return 1 + max(len(self.times) - NOISELESS_CALLS, 0)


def compute_negative_log_likelihood(
    clean: Tensor, mean: Tensor, log_variance: Tensor, limits: tuple[Tensor, Tensor]
) -> Tensor:
    """Return the negative log likelihood of clean signals (B, ...) under a Gaussian, in nats (Ho et al.).

    Signals are discretised in bins of 2/255. The outermost bins extend to infinity.
    """
    scale, (low, high) = (-log_variance / 2).exp(), limits
    below, above = (torch.special.ndtr((clean + edge - mean) * scale) for edge in (-BIN / 2, BIN / 2))
    below = torch.where(clean < low + BIN / 8, 0.0, below)
    above = torch.where(clean > high - BIN / 8, 1.0, above)
    return -(above - below).clamp_min(1e-12).log()


class TimeEmbedding(nn.Module):
    """An embedding of the diffusion time: sines and cosines, then Linear, SiLU, Linear (Ho et al. 2020).

    Args:
        width: d, the width of the embedding.
        sines: total number of sines and cosines; by default d.
    """

    PERIOD = 10_000

    rates: Tensor

    def __init__(self, width: int, sines: int | None = None):
        super().__init__()
        half = (sines or width) // 2
        rates = torch.exp(-math.log(self.PERIOD) * torch.arange(half) / half)
        self.register_buffer("rates", rates, persistent=False)
        self.mlp = nn.Sequential(nn.Linear(2 * len(rates), width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, time: Tensor) -> Tensor:
        """Map times (B,) to embeddings (B, d)."""
        angles = time[:, None] * self.rates
        return self.mlp(torch.cat([angles.cos(), angles.sin()], -1))
