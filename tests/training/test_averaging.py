"""Averages of weights: their values, and that looking at them changes nothing."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from memmlp.training.averaging import EMA


def test_an_exponential_moving_average_by_hand():
    """The decay is 2/11, 3/12, 4/13 and then 0.3: (1 + steps) / (10 + steps), and no more than its value."""
    model = nn.Linear(1, 1, bias=False)
    expected = model.weight.item()
    average = EMA(model, 0.3)
    for step, value in enumerate((4.0, 2.0, -1.0, 8.0), start=1):
        model.weight.data.fill_(value)
        average.update(step)
        decay = min(0.3, (1 + step) / (10 + step))
        expected = decay * expected + (1 - decay) * value
    with average.in_place():
        assert model.weight.item() == pytest.approx(expected)
    assert model.weight.item() == 8


def test_weights_come_back_after_an_error():
    model = nn.Linear(2, 2)
    average, before = EMA(model, 0.5), model.weight.detach().clone()
    model.weight.data += 1

    def fail() -> None:
        with average.in_place():
            assert torch.equal(model.weight, before)
            raise RuntimeError("in it")

    with pytest.raises(RuntimeError, match="in it"):
        fail()
    assert torch.equal(model.weight, before + 1)
