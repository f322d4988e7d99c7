"""How many operations a training takes.

Counted are the FLOPs of the matrix products of the trained calls, forward and backward, as torch's own
counter sees them (torch.utils.flop_counter): a multiplication and an addition are two. Of a network whose
weights are all trained that is close to 3 x 2 x MACs of the forward pass (Kaplan et al. 2020, "Scaling laws
for neural language models", Sec. 2.1), less the gradients that nobody needs: those of the inputs, and of a
frozen VQ-VAE. Not counted are the optimiser, what is done element by element, calls without a gradient by
which a rollout or the network itself makes its history, validations, and runs upstream.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode, flop_registry

from memmlp.motion.body import FRAME_DIM
from memmlp.motion.dataset import MotionDataset
from memmlp.networks.motion_model import MotionModel
from memmlp.training.losses import Loss
from memmlp.training.optim import Optim
from memmlp.training.rollout import TeacherForcing
from memmlp.training.train_network import MotionTask

COUNTED = (2, 3)
"""Two batches whose counts give that of any, for a step is linear in its windows.

A single window is no batch to some layers.
"""


def training_flops(model: MotionModel, loss: Loss, optim: Optim) -> int:
    """Count the FLOPs of a whole training of a network.

    Args:
        model: the network, with any weights, on the CPU; it is not to be used afterwards.
        loss: its loss, for the branches that it has.
        optim: how many steps it is trained for, and of how many windows.
    """
    few, more = (step_flops(model, loss, replace(optim, batch=batch, compile=False)) for batch in COUNTED)
    each = (more - few) // (COUNTED[1] - COUNTED[0])
    return optim.steps * (few + (optim.batch - COUNTED[0]) * each)


def step_flops(model: MotionModel, loss: Loss, optim: Optim) -> int:
    """Count the FLOPs of one training step, by taking it on random frames."""
    task = MotionTask(model, loss, TeacherForcing(), _frames(model), optim, 0, validate=lambda network: {})
    task.module.train()
    with FlopCounterMode(display=False, custom_mapping=_WITH_GRADIENT) as forward:
        loss_of_step = task.step(0).loss
    with FlopCounterMode(display=False) as backward:
        loss_of_step.backward()
    return int(forward.get_total_flops() + backward.get_total_flops())


def _with_gradient(count: Callable[..., int]) -> Callable[..., int]:
    """Return what counts an operation's FLOPs, but none of a call without a gradient."""

    def counted(*args: Any, **kwargs: Any) -> int:
        return count(*args, **kwargs) if torch.is_grad_enabled() else 0

    counted._get_raw = True  # type: ignore[attr-defined]  # it is given tensors, as the registry's are
    return counted


_WITH_GRADIENT = {operation: _with_gradient(count) for operation, count in flop_registry.items()}


def _frames(model: MotionModel) -> MotionDataset:
    """Return a clip of random frames that is as long as a training call sees."""
    length = model.length + model.stride
    draw = torch.Generator().manual_seed(0)
    frames = torch.randn(length, FRAME_DIM, generator=draw)
    return MotionDataset(frames, torch.tensor([0]), torch.tensor([length]), ["random"])
