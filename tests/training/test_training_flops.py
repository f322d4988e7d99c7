"""The FLOPs of a training: those that torch counts in a real step, and what the networks' layers imply."""

from __future__ import annotations

from dataclasses import replace

import pytest
import tiny
import tiny_tasks
import torch
from torch import nn

from memmlp.networks.flop_counter import counting_flops
from memmlp.networks.memory import NoMemory
from memmlp.training.loop import train_step
from memmlp.training.training_flops import training_flops


@pytest.mark.parametrize("name", ["mem_mlp", "avatar_poser", "agrol_mlp"])
def test_a_training_is_as_many_steps_as_the_loop_takes(name: str):
    """Of a batch and a loss as they are trained, in the loop's own step."""
    optim = replace(tiny_tasks.OPTIM, steps=7, batch=5)
    task = (
        tiny_tasks.motion_task("forced", optim)
        if name == "mem_mlp"
        else tiny_tasks.baseline_task(name, optim)
    )
    optimiser = optim.build(task.parameter_groups())
    with counting_flops() as counter:
        train_step(task, optim, optimiser, 0)
    assert training_flops(task.model, task.loss, optim) == 7 * counter.get_total_flops()


def test_a_linear_layers_share_is_six_operations_a_weight():
    """3 x 2 x MACs, less the gradient of the inputs, which the stem does not need."""
    model = tiny.model(NoMemory)
    loss = tiny_tasks.motion_task("forced", kind=NoMemory).loss
    optim = replace(tiny_tasks.OPTIM, steps=1, batch=4)
    before = training_flops(model, loss, optim)
    model.stem = nn.Sequential(model.stem, nn.Linear(16, 16))
    assert training_flops(model, loss, optim) - before == 3 * 2 * 4 * 7 * 16 * 16


def test_free_running_without_a_gradient_is_not_counted():
    """RPM draws for each call how many frames it runs freely before the trained step."""
    task = tiny_tasks.baseline_task("rpm", tiny_tasks.OPTIM)
    counts = set()
    for seed in range(6):
        torch.manual_seed(seed)
        counts.add(training_flops(task.model, task.loss, tiny_tasks.OPTIM))
    assert len(counts) == 1
    assert counts.pop() > 0
