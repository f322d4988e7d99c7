"""How a module is trained: steps, batches, learning rates."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

SCHEDULES: dict[str, Callable[[float, float, float], float]] = {
    # (progress in [0, 1), final rate / first rate, where the step falls) -> factor
    "step": lambda done, final, drop_at: 1.0 if done < drop_at else final,
    "cosine": lambda done, final, drop_at: final + (1 - final) * 0.5 * (1 + math.cos(math.pi * done)),
    "milestones": lambda done, final, drop_at: 0.2 ** sum(done >= at for at in (0.2, 0.5, 0.7)),
}


@dataclass(frozen=True)
class Optim:
    """How a module is trained.

    Attributes:
        steps, batch: length and windows (or frames) a step.
        lr, final_lr: learning rate at the start and at the end of the schedule.
        schedule: "step" (falls to final_lr at the fraction drop_at), "cosine", or "milestones" (App. A).
        decoupled: AdamW's weight decay; else Adam's.
        clip_norm: largest norm of the gradient, 0 for none.
        precision: "fp32" or "bf16" (autocast). compile: torch.compile the model's call.
    """

    steps: int
    batch: int
    lr: float
    final_lr: float = 0.0
    schedule: str = "step"
    drop_at: float = 0.75
    weight_decay: float = 1e-4
    betas: tuple[float, float] = (0.9, 0.999)
    decoupled: bool = True
    clip_norm: float = 0.0
    precision: str = "fp32"
    compile: bool = False
    checkpoint_every: int = 500
    validate_every: int = 1000
    log_every: int = 50

    def factor(self, step: int) -> float:
        """The learning rate at a step over the first one."""
        return SCHEDULES[self.schedule](step / self.steps, self.final_lr / self.lr, self.drop_at)

    def build(self, groups: list[dict]) -> torch.optim.Optimizer:
        """The optimiser over parameter groups; a group's own `lr` and `weight_decay` win."""
        kind = torch.optim.AdamW if self.decoupled else torch.optim.Adam
        return kind(groups, lr=self.lr, weight_decay=self.weight_decay, betas=self.betas)


def vqvae_optim(
    steps: int,
    batch: int,
    lr: float,
    weight_decay: float,
    checkpoint_every: int = Optim.checkpoint_every,
    log_every: int = Optim.log_every,
) -> Optim:
    """How a VQ-VAE is trained: Adam, its rate times 0.2 at 20, 50 and 70 % of the steps (App. A)."""
    return Optim(
        steps=steps,
        batch=batch,
        lr=lr,
        schedule="milestones",
        weight_decay=weight_decay,
        betas=(0.9, 0.99),
        decoupled=False,
        checkpoint_every=checkpoint_every,
        validate_every=steps,
        log_every=log_every,
    )
