"""What Muon needs besides torch: two optimisers as one, and fast bfloat16 products on all processors."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer
from torch.overrides import TorchFunctionMode

PRODUCTS = {torch.matmul, torch.Tensor.matmul, torch.Tensor.__matmul__, torch.mm, torch.addmm}


class ComposedOptimiser(Optimizer):
    """Several optimisers as one, with the parameter groups and the state of all of them.

    Args:
        parts: the optimisers, which have no parameter in common.
    """

    def __init__(self, parts: Sequence[Optimizer]):
        self.parts = tuple(parts)
        super().__init__([group for part in parts for group in part.param_groups], {})
        self._share()

    def _share(self) -> None:
        start = 0
        for part in self.parts:  # each uses the groups and the state themselves, not copies
            end = start + len(part.param_groups)
            part.param_groups, part.state = self.param_groups[start:end], self.state
            start = end

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> None:  # type: ignore[override]
        """Take a step of each part; a closure is not supported."""
        with widen_products():
            for part in self.parts:
                part.step()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load the groups and the state of all parts."""
        super().load_state_dict(state_dict)
        self._share()


class WideProducts(TorchFunctionMode):
    """Within it, products of bfloat16 matrices on the CPU are computed in float32 and rounded.

    A processor without instructions for bfloat16 is six times slower at them than at float32. Products of two
    bfloat16 numbers are exact in float32, and sums are in float32, so the result is that of the instructions.
    """

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Sequence[type],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        """Call a function of torch."""
        if func in PRODUCTS and all(map(_is_narrow, args)):
            return func(*(tensor.float() for tensor in args), **(kwargs or {})).bfloat16()
        return func(*args, **(kwargs or {}))


def widen_products() -> AbstractContextManager[object]:
    """Return `WideProducts` on a processor without instructions for bfloat16, and nothing on others."""
    return nullcontext() if has_bfloat16_products() else WideProducts()


@functools.cache
def has_bfloat16_products() -> bool:
    """Return whether this processor has instructions for products of bfloat16; only x86 is asked."""
    ask: Callable[[], dict[str, Any]] = getattr(torch.cpu, "get_capabilities", dict)  # newer than some torch
    known = ask()
    return known.get("architecture") != "x86_64" or bool(known.get("avx512_bf16") or known.get("amx_bf16"))


def _is_narrow(tensor: Any) -> bool:
    return isinstance(tensor, Tensor) and tensor.dtype == torch.bfloat16 and tensor.device.type == "cpu"
