"""Denoising diffusion with a network that predicts the clean signal: noise schedule, training noise, DDIM."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

Denoise = Callable[[Tensor, Tensor], Tensor]


def cosine_schedule(steps: int) -> Tensor:
    """Shares of signal (steps,) in the noisy signal's variance (Nichol & Dhariwal 2021, Eq. 17), float64.

    A step's share of noise is at most 0.999.
    """
    offset = 0.008
    time = torch.arange(steps + 1, dtype=torch.float64) / steps
    level = ((time + offset) / (1 + offset) * math.pi / 2).cos().square()
    kept = (level[1:] / level[:-1]).clamp_min(1 - 0.999)
    return kept.cumprod(0)


class Diffusion(nn.Module):
    """The noise of training and the way back from it.

    Args:
        steps: of the schedule. sampling_steps: denoiser calls of a sample, evenly spaced from the last
            step down (Song et al. 2021, App. D.2: linear), so that the first one sees noise alone.
    """

    signal: Tensor

    def __init__(self, steps: int, sampling_steps: int):
        super().__init__()
        self.steps = steps
        self.times = [steps * (i + 1) // sampling_steps - 1 for i in reversed(range(sampling_steps))]
        self.register_buffer("signal", cosine_schedule(steps).float(), persistent=False)

    def noised(self, clean: Tensor, time: Tensor, noise: Tensor) -> Tensor:
        """Clean signals (B, ...) at times (B,) with standard normal noise of their shape."""
        signal = self.signal[time].view(-1, *[1] * (clean.dim() - 1))
        return signal.sqrt() * clean + (1 - signal).sqrt() * noise

    def sample(self, denoise: Denoise, noise: Tensor) -> Tensor:
        """The clean signal (B, ...) by DDIM without noise of its own (Song et al. 2021, Eq. 12, eta = 0).

        Args:
            denoise: noisy signal (B, ...) and times (B,) -> its estimate of the clean signal.
            noise: where it starts from (B, ...).
        """
        x = noise
        for index, time in enumerate(self.times):
            clean = denoise(x, torch.full((len(x),), time, device=x.device))
            if index + 1 < len(self.times):
                x = self.stepped(x, clean, index)
        return clean

    def stepped(self, x: Tensor, clean: Tensor, index: int) -> Tensor:
        """The noisy signal one sampling step on, of x and the estimate made from it at step `index`."""
        here, there = (self.signal[time] for time in self.times[index : index + 2])
        direction = (x - here.sqrt() * clean) / (1 - here).sqrt()
        return there.sqrt() * clean + (1 - there).sqrt() * direction
