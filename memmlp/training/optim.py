"""How a module is optimised: steps, batches, learning rates, precision."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

SCHEDULES: dict[str, Callable[[float, float, float], float]] = {
    # Each maps the progress in [0, 1), final rate / first rate and `drop_at` to the factor on the first rate.
    "step": lambda done, final, drop_at: 1.0 if done < drop_at else final,
    "cosine": lambda done, final, drop_at: final + (1 - final) * 0.5 * (1 + math.cos(math.pi * done)),
    "milestones": lambda done, final, drop_at: 0.2 ** sum(done >= at for at in (0.2, 0.5, 0.7)),
}


@dataclass(frozen=True)
class Optim:
    """How a module is optimised.

    Attributes:
        steps: number of training steps.
        batch: windows (of a VQ-VAE: frames) a step.
        lr: learning rate at the start.
        final_lr: learning rate at the end of the schedules "step" and "cosine".
        schedule: "step" (falls to `final_lr` at the fraction `drop_at` of the steps), "cosine", or
            "milestones" (times 0.2 at 20, 50 and 70 % of the steps, App. A).
        drop_at: see `schedule`.
        weight_decay: weight decay.
        betas: Adam's two decay rates.
        decoupled: whether weight decay is AdamW's; otherwise it is Adam's.
        clip_norm: largest norm of the gradient, 0 for no limit.
        precision: "fp32" or "bf16" (autocast).
        compile: whether the model's training call is compiled by torch.compile.
        checkpoint_every: steps between checkpoints.
        validate_every: steps between validations.
        log_every: steps between entries of the log.
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
        """Return the learning rate at a step as a fraction of the first one."""
        return SCHEDULES[self.schedule](step / self.steps, self.final_lr / self.lr, self.drop_at)

    def build(self, groups: list[dict]) -> torch.optim.Optimizer:
        """Make the optimiser over parameter groups; a group's own `lr` and `weight_decay` take precedence."""
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
    """Return how a VQ-VAE is optimised: Adam, its rate times 0.2 at 20, 50 and 70 % of the steps (App. A).

    Validation is done once, at the end.
    """
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
