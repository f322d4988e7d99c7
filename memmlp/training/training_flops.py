"""How many operations a training takes.

The count covers the FLOPs of matrix products in training calls, forward and backward, as
memmlp.networks.flop_counter counts them; a multiplication and an addition are two FLOPs. For a network whose
weights are all trained, this is close to 3 x 2 x MACs of the forward pass (Kaplan et al. 2020, "Scaling laws
for neural language models", Sec. 2.1), minus the gradients that are not needed: those of the inputs, and of a
frozen VQ-VAE. It does not cover the optimiser, element-wise operations, calls without gradients by which a
rollout or the network itself makes its history, validations, or the runs upstream.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from memmlp.motion.body import FRAME_DIM
from memmlp.motion.dataset import MotionDataset
from memmlp.networks.flop_counter import counting_flops
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
        model: the network, with any weights, on the CPU; do not use it afterwards.
        loss: the loss for the branches that the network has.
        optim: says how many steps are taken, and how many windows each has.
    """
    few, more = (step_flops(model, loss, replace(optim, batch=batch, compile=False)) for batch in COUNTED)
    each = (more - few) // (COUNTED[1] - COUNTED[0])
    return optim.steps * (few + (optim.batch - COUNTED[0]) * each)


def step_flops(model: MotionModel, loss: Loss, optim: Optim) -> int:
    """Count the FLOPs of one training step, by taking it on random frames."""
    task = MotionTask(model, loss, TeacherForcing(), _frames(model), optim, 0, validate=lambda network: {})
    task.module.train()
    with counting_flops(with_gradients_alone=True) as forward:
        loss_of_step = task.step(0).loss
    with counting_flops() as backward:
        loss_of_step.backward()
    return int(forward.get_total_flops() + backward.get_total_flops())


def _frames(model: MotionModel) -> MotionDataset:
    """Return a dataset of one clip of random frames, as long as a training call needs."""
    length = model.past_frames + model.stride
    draw = torch.Generator().manual_seed(0)
    frames = torch.randn(length, FRAME_DIM, generator=draw)
    return MotionDataset(frames, torch.tensor([0]), torch.tensor([length]), ["random"])
