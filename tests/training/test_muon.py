"""Several optimisers as one, and products of bfloat16 matrices that are computed in float32."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from memmlp.training import optim
from memmlp.training.optim import ComposedOptimiser, WideProducts, has_bfloat16_products, widen_products


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


def test_it_does_what_its_parts_do_also_after_a_rate_was_changed_and_its_state_was_loaded():
    alone, together = network(), network()
    separate, composed = parts(alone), ComposedOptimiser(parts(together))
    for number in range(6):
        for group in (*composed.param_groups, *(g for one in separate for g in one.param_groups)):
            group["lr"] *= 0.9
        step(alone, *separate)
        step(together, composed)
        assert all(map(torch.equal, alone.parameters(), together.parameters()))
        if number == 2:
            state = composed.state_dict()
            composed = ComposedOptimiser(parts(together))
            composed.load_state_dict(state)
    assert not torch.equal(alone.bias, network().bias)
    assert list(composed.state_dict()["state"]) == [0, 1]


def matrices(*shapes: tuple[int, int]) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(shape, generator=generator).bfloat16() for shape in shapes]


def test_products_are_exact_but_for_one_rounding():
    a, b, c = matrices((9, 30), (30, 7), (9, 7))
    left, right, added = (x.double().numpy() for x in (a, b, c))

    def rounded(x: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(x).bfloat16()

    with WideProducts():
        plain, method, sum_ = a @ b, a.matmul(b), torch.addmm(c, a, b, beta=-4.775, alpha=2.0)
        assert (a + 1).dtype == torch.bfloat16
    torch.testing.assert_close(plain, rounded(left @ right), rtol=2**-8, atol=0)
    torch.testing.assert_close(sum_, rounded(-4.775 * added + 2 * left @ right), rtol=2**-8, atol=2**-8)
    assert torch.equal(plain, method)
    assert {x.dtype for x in (plain, method, sum_)} == {torch.bfloat16}


def test_a_processor_is_asked(monkeypatch):
    for architecture, instructions, has in (
        ("x86_64", (), False),
        ("x86_64", ("avx512_bf16",), True),
        ("x86_64", ("amx_bf16",), True),
        ("aarch64", (), True),
    ):
        known = {"architecture": architecture, "avx512_bf16": False, "amx_bf16": False}
        known |= dict.fromkeys(instructions, True)
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda known=known: known)
        monkeypatch.setattr(optim, "has_bfloat16_products", has_bfloat16_products.__wrapped__)
        assert optim.has_bfloat16_products() is has
        assert isinstance(widen_products(), WideProducts) is not has


def test_muon_takes_the_same_steps_with_either(monkeypatch):
    """Newton and Schulz' iteration loses what a rounding differs by."""

    def stepped(narrow: bool) -> torch.Tensor:
        monkeypatch.setattr(optim, "has_bfloat16_products", lambda: narrow)
        torch.manual_seed(0)
        weight = torch.nn.Parameter(torch.randn(12, 20))
        optimiser = ComposedOptimiser([torch.optim.Muon([weight], 0.02)])
        for _ in range(3):
            weight.grad = torch.sin(weight.detach())
            optimiser.step()
        return weight.detach()

    torch.testing.assert_close(stepped(True), stepped(False), atol=2e-3, rtol=0)
