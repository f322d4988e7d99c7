"""The products of a training step are those that torch counts."""

import pytest
from tiny_tasks import OPTIM, motion_task, recurrent_task
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.training_step import ProductRecorder
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
