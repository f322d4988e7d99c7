"""Products of bfloat16 matrices on processors that have no instructions for them.

Such processors are six times slower at them than at float32. So they multiply in float32 here and round the
result to bfloat16, which is what the instructions of others do: products of two bfloat16 numbers are exact in
float32, sums are in float32.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

PRODUCTS = {torch.matmul, torch.Tensor.matmul, torch.Tensor.__matmul__, torch.mm, torch.addmm}


class WideProducts(TorchFunctionMode):
    """Within it, products of bfloat16 matrices on the CPU are computed in float32 and rounded."""

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Sequence[type],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        """Call a function of torch."""
        if func in PRODUCTS and all(map(_narrow, args)):
            return func(*(tensor.float() for tensor in args), **(kwargs or {})).bfloat16()
        return func(*args, **(kwargs or {}))


def wide_where_needed() -> AbstractContextManager[object]:
    """Return `WideProducts` on a processor without instructions for bfloat16, and nothing on others."""
    return nullcontext() if multiplies_bfloat16() else WideProducts()


@functools.cache
def multiplies_bfloat16() -> bool:
    """Return whether this processor has instructions for products of bfloat16; x86 is asked alone."""
    ask: Callable[[], dict[str, Any]] = getattr(torch.cpu, "get_capabilities", dict)  # newer than some torch
    known = ask()
    return known.get("architecture") != "x86_64" or bool(known.get("avx512_bf16") or known.get("amx_bf16"))


def _narrow(tensor: Any) -> bool:
    return isinstance(tensor, Tensor) and tensor.dtype == torch.bfloat16 and tensor.device.type == "cpu"
