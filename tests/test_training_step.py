"""The products of a training step are those that torch counts, and its time includes them."""

import pytest
import torch
from tiny_tasks import OPTIM, motion_task, recurrent_task
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.training_step import ProductRecorder, measure_step_cost
from memmlp.training.loop import train_step


@pytest.mark.parametrize("make", [motion_task, recurrent_task])
def test_the_recorded_products_are_those_of_a_step(make):
    task = make("forced")
    optimiser = OPTIM.build(task.parameter_groups())
    with FlopCounterMode(display=False) as counter, ProductRecorder() as recorder:
        train_step(task, OPTIM, optimiser, 0)
    assert recorder.flops == counter.get_total_flops() > 0
    with FlopCounterMode(display=False) as counter:
        recorder.replay()
    assert recorder.flops == counter.get_total_flops()


def test_a_step_takes_longer_than_its_products():
    threads = torch.get_num_threads()
    cost = measure_step_cost(motion_task("forced"), OPTIM, rounds=3, steps=2, with_kernels=True)
    assert cost.ratios.shape == (3,)
    assert cost.ratios.min() > 1
    assert cost.kernels[0][1] >= cost.kernels[1][1] > 0
    assert torch.get_num_threads() == threads
