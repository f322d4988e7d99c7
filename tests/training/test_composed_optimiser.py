"""Several optimisers as one do what they do by themselves, and have one state."""

from __future__ import annotations

import torch
from torch import nn

from memmlp.training.composed_optimiser import ComposedOptimiser


def network() -> nn.Linear:
    torch.manual_seed(0)
    return nn.Linear(3, 2)


def parts(model: nn.Linear) -> list[torch.optim.Optimizer]:
    return [torch.optim.SGD([model.weight], lr=0.1, momentum=0.9), torch.optim.AdamW([model.bias], lr=0.2)]


def step(model: nn.Linear, *optimisers: torch.optim.Optimizer) -> None:
    for optimiser in optimisers:
        optimiser.zero_grad()
    model(torch.ones(1, 3)).square().sum().backward()
    for optimiser in optimisers:
        optimiser.step()


def equal(one: nn.Linear, other: nn.Linear) -> bool:
    return torch.equal(one.weight, other.weight) and torch.equal(one.bias, other.bias)


def test_it_does_what_its_parts_do_also_after_a_rate_was_changed_and_its_state_was_loaded():
    alone, together = network(), network()
    separate, composed = parts(alone), ComposedOptimiser(parts(together))
    for number in range(6):
        for group in (*composed.param_groups, *(g for one in separate for g in one.param_groups)):
            group["lr"] *= 0.9
        step(alone, *separate)
        step(together, composed)
        assert equal(alone, together)
        if number == 2:
            state = composed.state_dict()
            composed = ComposedOptimiser(parts(together))
            composed.load_state_dict(state)
    assert not equal(alone, network())
    assert list(composed.state_dict()["state"]) == [0, 1]
