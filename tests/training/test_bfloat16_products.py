"""Products of bfloat16 matrices, computed in float32."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from memmlp.training import bfloat16_products
from memmlp.training.bfloat16_products import WideProducts, multiplies_bfloat16, wide_where_needed
from memmlp.training.composed_optimiser import ComposedOptimiser


def matrices(*shapes: tuple[int, int]) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(shape, generator=generator).bfloat16() for shape in shapes]


def rounded(x: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(x).bfloat16()


def test_products_are_exact_but_for_one_rounding():
    a, b, c = matrices((9, 30), (30, 7), (9, 7))
    left, right, added = (x.double().numpy() for x in (a, b, c))
    with WideProducts():
        plain, method, sum_ = a @ b, a.matmul(b), torch.addmm(c, a, b, beta=-4.775, alpha=2.0)
    torch.testing.assert_close(plain, rounded(left @ right), rtol=2**-8, atol=0)
    torch.testing.assert_close(sum_, rounded(-4.775 * added + 2 * left @ right), rtol=2**-8, atol=2**-8)
    assert torch.equal(plain, method)
    assert {x.dtype for x in (plain, method, sum_)} == {torch.bfloat16}


def test_everything_else_is_torchs():
    a, b = (x.float() for x in matrices((9, 30), (30, 7)))
    expected = a @ b
    with WideProducts():
        assert torch.equal(a @ b, expected)
        assert (a.bfloat16() + 1).dtype == torch.bfloat16


@pytest.mark.parametrize(
    ("known", "has"),
    [
        ({"architecture": "x86_64", "avx512_bf16": False, "amx_bf16": False}, False),
        ({"architecture": "x86_64", "avx512_bf16": True, "amx_bf16": False}, True),
        ({"architecture": "x86_64", "avx512_bf16": False, "amx_bf16": True}, True),
        ({"architecture": "aarch64"}, True),
    ],
)
def test_a_processor_is_asked(known, has, monkeypatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: known)
    monkeypatch.setattr(bfloat16_products, "multiplies_bfloat16", multiplies_bfloat16.__wrapped__)
    assert bfloat16_products.multiplies_bfloat16() is has
    assert isinstance(wide_where_needed(), WideProducts) is not has


def test_muon_steps_alike_with_either(monkeypatch):
    """Newton and Schulz' iteration loses what a rounding differs by."""

    def stepped(narrow: bool) -> torch.Tensor:
        monkeypatch.setattr(bfloat16_products, "multiplies_bfloat16", lambda: narrow)
        torch.manual_seed(0)
        weight = torch.nn.Parameter(torch.randn(12, 20))
        optimiser = ComposedOptimiser([torch.optim.Muon([weight], 0.02)])
        for _ in range(3):
            weight.grad = torch.sin(weight.detach())
            optimiser.step()
        return weight.detach()

    torch.testing.assert_close(stepped(True), stepped(False), atol=2e-3, rtol=0)
