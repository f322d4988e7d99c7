"""Diffusion whose network predicts the noise and how certain each step is (Nichol & Dhariwal 2021)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from memmlp.networks.baselines.diffusion import Noising, at, linear_schedule

Step = Callable[[Tensor, int], tuple[Tensor, Tensor]]
"""Maps a noisy signal and the number of its sampling step to the next one's mean and deviation."""

QUIET = 50  # from this time of the noise schedule on a sample takes the mean; BoDiffusion's code has 49
BIN = 2 / 255  # the width of the bins of the first step's likelihood: a pixel's, as BoDiffusion's code has it


class Denoised(NamedTuple):
    """What a network predicts from noisy signals (B, ...).

    Attributes:
        noise: the noise in the signals (B, ...).
        share: where the logarithm of a step's variance lies (B, ...) between its limits: -1 at the least
            variance, 1 at the largest.
    """

    noise: Tensor
    share: Tensor


def posterior(signal: Tensor) -> Tensor:
    """Return the coefficients of the step from a noisy signal to the one before it (Ho et al. 2020, Eq. 7).

    Args:
        signal: share (n,) of signal in the noisy signal's variance, float64.

    Returns:
        (4, n): the mean's coefficients of the clean and of the noisy signal, and the logarithms of the least
        and of the largest variance. The very first step's least variance, 0, is replaced by the second's.
    """
    before = torch.cat([torch.ones_like(signal[:1]), signal[:-1]])
    added = 1 - signal / before
    least = added * (1 - before) / (1 - signal)
    least = torch.cat([least[1:2], least[1:]]) if len(signal) > 1 else added
    clean = added * before.sqrt() / (1 - signal)
    noisy = (1 - before) * (signal / before).sqrt() / (1 - signal)
    return torch.stack([clean, noisy, least.log(), added.log()])


class AncestralDiffusion(Noising):
    """Diffusion with a linear schedule, whose network predicts noise and variances; sampled step by step.

    Args:
        steps: number of steps of the noise schedule.
        sampling_steps: number of denoiser calls for a sample; see Noising.
    """

    trained: Tensor
    spaced: Tensor

    def __init__(self, steps: int, sampling_steps: int):
        signal = linear_schedule(steps)
        super().__init__(signal, sampling_steps)
        self.register_buffer("trained", posterior(signal).float(), persistent=False)
        spaced = posterior(signal[self.times[::-1]]).flip(-1)  # by sampling step: the noisiest first
        self.register_buffer("spaced", spaced.float(), persistent=False)

    @property
    def draws(self) -> int:
        """How many draws of noise a sample takes: one for its start, one for each step that adds noise.

        The last step adds none, nor do those in the last 50 times of the schedule, of which a sample of few
        steps has hardly any: without noise its steps' means are no sample of what the network has learned.
        """
        return 1 + sum(time >= QUIET for time in self.times[:-1])

    def clean(self, noisy: Tensor, noise: Tensor, time: Tensor) -> Tensor:
        """Return the clean signals (B, ...) of noisy ones, given their noise (B, ...) and times (B,)."""
        signal = at(self.signal, time, noisy)
        return (noisy - (1 - signal).sqrt() * noise) / signal.sqrt()

    def losses(
        self, clean: Tensor, noise: Tensor, time: Tensor, made: Denoised, limits: tuple[Tensor, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Return the hybrid loss' two terms, means over components (Nichol & Dhariwal 2021, Eq. 16).

        Args:
            clean: true signals (B, ...).
            noise: the noise (B, ...) that was mixed into them.
            time: the times (B,) at which the noise was mixed in.
            made: what the network predicted from the noisy signals.
            limits: the least and the largest value of a clean signal, to be broadcast to it.

        Returns:
            The mean squared error of the noise, and the variational bound in bits, whose gradient reaches the
            variances only.
        """
        noisy = self.noised(clean, time, noise)
        first, second, least, largest = at(self.trained, time, clean)
        found = first * self.clean(noisy, made.noise.detach(), time) + second * noisy
        true = first * clean + second * noisy
        log_variance = least + (made.share + 1) / 2 * (largest - least)
        spread = log_variance - least
        divergence = (spread + (-spread).exp() + (true - found).square() * (-log_variance).exp() - 1) / 2
        surprise = binned_surprise(clean, found, log_variance, limits)
        bound = torch.where(time.view_as(first) == 0, surprise, divergence)
        return (noise - made.noise).square().mean(), bound.mean() / math.log(2)

    def step(
        self, noisy: Tensor, made: Denoised, index: int, limits: tuple[Tensor, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Return the mean and the variance (B, ...) of the signal after a sampling step.

        The last step's estimate is not clamped to the limits: if the network has not learned a rotation,
        clamping could make the two columns of its 6D form parallel, which is no rotation.

        Args:
            noisy: the noisy signal (B, ...) at sampling step `index`.
            made: what the network predicted from the noisy signal.
            index: number of the sampling step, from 0.
            limits: the least and the largest value to which the estimate of the clean signal is clamped.
        """
        time = torch.full((1,), self.times[index], device=noisy.device)
        first, second, least, largest = self.spaced[:, index]
        clean = self.clean(noisy, made.noise, time)
        if index + 1 < len(self.times):
            clean = clean.clamp(*limits)
        mean = first * clean + second * noisy
        return mean, (least + (made.share + 1) / 2 * (largest - least)).exp()

    def sample(self, step: Step, noise: Tensor) -> Tensor:
        """Sample a clean signal (...) from draws of noise (`draws`, ...)."""
        x, *further = noise
        for index in range(len(self.times)):
            mean, deviation = step(x, index)
            x = mean + deviation * further[index] if index < len(further) else mean
        return x


def binned_surprise(
    clean: Tensor, mean: Tensor, log_variance: Tensor, limits: tuple[Tensor, Tensor]
) -> Tensor:
    """Return how surprising clean signals (B, ...) are to a Gaussian, in nats, by bins of 2/255 (Ho et al.).

    The two outermost bins, at the limits, reach to minus and plus infinity.
    """
    scale, (low, high) = (-log_variance / 2).exp(), limits
    below, above = (torch.special.ndtr((clean + edge - mean) * scale) for edge in (-BIN / 2, BIN / 2))
    below = torch.where(clean < low + BIN / 8, 0.0, below)
    above = torch.where(clean > high - BIN / 8, 1.0, above)
    return -(above - below).clamp_min(1e-12).log()
