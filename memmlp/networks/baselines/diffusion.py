"""Denoising diffusion: schedules of noise, the noising of training signals, and DDIM.

DDIM is for networks that predict the clean signal; memmlp.networks.baselines.ancestral_diffusion is for
those that predict the noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

Denoise = Callable[[Tensor, Tensor], Tensor]


def cosine_schedule(steps: int) -> Tensor:
    """Return the cosine schedule: the signal's share (steps,) of the noisy signal's variance, float64.

    This is Eq. 17 of Nichol & Dhariwal 2021, where the noise that one step adds has a share of at most 0.999.
    """
    offset = 0.008
    time = torch.arange(steps + 1, dtype=torch.float64) / steps
    level = ((time + offset) / (1 + offset) * math.pi / 2).cos().square()
    kept = (level[1:] / level[:-1]).clamp_min(1 - 0.999)
    return kept.cumprod(0)


def linear_schedule(steps: int) -> Tensor:
    """Return the linear schedule: the signal's share (steps,) of the noisy signal's variance, float64.

    The noise that one step adds has a share that grows linearly from 1e-4 to 0.02 over 1000 steps (Ho et al.
    2020, Sec. 4); with fewer steps each one adds proportionally more, at most 0.999.
    """
    added = torch.linspace(1e-4, 0.02, steps, dtype=torch.float64) * (1000 / steps)
    return (1 - added.clamp_max(0.999)).cumprod(0)


class Noising(nn.Module):
    """The noising of training signals, and the times at which a sample is denoised.

    Args:
        signal: share (steps,) of signal in the noisy signal's variance, by step.
        sampling_steps: number of denoiser calls for a sample, evenly spaced, from the noise schedule's last
            step down (Song et al. 2021, App. D.2: linear), so that the first one sees noise alone.
    """

    signal: Tensor

    def __init__(self, signal: Tensor, sampling_steps: int):
        super().__init__()
        self.steps = len(signal)
        self.times = [self.steps * (i + 1) // sampling_steps - 1 for i in reversed(range(sampling_steps))]
        self.register_buffer("signal", signal.float(), persistent=False)

    def random_times(self, clean: Tensor) -> Tensor:
        """Draw a time (B,) for each signal of a batch (B, ...)."""
        return torch.randint(self.steps, (len(clean),), device=clean.device)

    def noised(self, clean: Tensor, time: Tensor, noise: Tensor) -> Tensor:
        """Mix clean signals (B, ...) with standard normal noise (B, ...) as the times (B,) demand."""
        signal = at(self.signal, time, clean)
        return signal.sqrt() * clean + (1 - signal).sqrt() * noise


def at(table: Tensor, time: Tensor, like: Tensor) -> Tensor:
    """Return a table's values (..., B, 1, ...) at times (B,), to be broadcast to signals (B, ...)."""
    return table[..., time].unflatten(-1, (-1, *[1] * (like.dim() - 1)))


class Diffusion(Noising):
    """Diffusion with a cosine schedule, whose network predicts the clean signal; DDIM samples it.

    Args:
        steps: number of steps of the noise schedule.
        sampling_steps: number of denoiser calls for a sample; see Noising.
    """

    def __init__(self, steps: int, sampling_steps: int):
        super().__init__(cosine_schedule(steps), sampling_steps)

    def sample(self, denoise: Denoise, noise: Tensor) -> Tensor:
        """Sample the clean signal (B, ...) by DDIM that adds no noise (Song et al. 2021, Eq. 12, eta = 0).

        Args:
            denoise: maps a noisy signal (B, ...) and times (B,) to an estimate of the clean signal.
            noise: the noise (B, ...) to start from.
        """
        x = noise
        for index, time in enumerate(self.times):
            clean = denoise(x, torch.full((len(x),), time, device=x.device))
            if index + 1 < len(self.times):
                x = self.stepped(x, clean, index)
        return clean

    def stepped(self, x: Tensor, clean: Tensor, index: int) -> Tensor:
        """Take one sampling step.

        Args:
            x: the noisy signal (B, ...) at sampling step `index`.
            clean: the estimate of the clean signal that was made from it.
            index: number of the sampling step, from 0.

        Returns:
            The noisy signal (B, ...) at sampling step `index` + 1.
        """
        here, there = (self.signal[time] for time in self.times[index : index + 2])
        direction = (x - here.sqrt() * clean) / (1 - here).sqrt()
        return there.sqrt() * clean + (1 - there).sqrt() * direction
