"""Counts the FLOPs of the matrix products that networks compute on a CPU.

torch's own counter (torch.utils.flop_counter) counts 0 for operators without a formula. This module adds
formulas for CPU kernels, and warns about products that still lack one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch
from torch.backends import mha
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode, flop_registry, shape_wrapper

from memmlp.common.progress import to_stderr

PRODUCTS = frozenset(
    {
        "mm", "addmm", "bmm", "baddbmm", "addbmm", "mv", "addmv", "dot", "vdot", "matmul", "linear",
        "bilinear", "trilinear", "conv", "convolution", "attention", "transformer", "rnn", "lstm", "gru",
    }
)  # fmt: skip
"""Words in the names of operators that compute matrix products."""


@contextmanager
def counting_flops() -> Iterator[FlopCounterMode]:
    """Count the FLOPs of matrix products within the context; a multiplication and an addition are two.

    Products in operators without a formula are not counted, and named in a warning on stderr; torch's
    `register_flop_formula` adds a formula.
    """
    counter = FlopCounterMode(display=False)
    counter.flop_registry = formulas = {**flop_registry, **_CPU_FORMULAS}
    left_out = _Uncounted(formulas)
    fast = mha.get_fastpath_enabled()
    mha.set_fastpath_enabled(False)  # whole layers as one kernel, without its products
    try:
        with left_out, counter:
            yield counter
    finally:
        mha.set_fastpath_enabled(fast)
    if left_out.names:
        _warn(", ".join(sorted(left_out.names)))


class _Uncounted(TorchDispatchMode):
    """Collects the names of products that run without a formula."""

    supports_higher_order_operators = True

    def __init__(self, formulas: dict[Any, Callable[..., int]]):
        super().__init__()
        self.formulas = formulas
        self.names: set[str] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        operator = getattr(func, "_overloadpacket", func)
        if operator not in self.formulas and not PRODUCTS.isdisjoint(operator.__name__.split("_")):
            self.names.add(operator.__name__)
        return func(*args, **(kwargs or {}))


@cache  # once, however often a network is counted
def _warn(names: str) -> None:
    to_stderr(f"memmlp: warning: MACs and FLOPs do not count {names}, which have no formula")


def _lstm_flops(x: Sequence[int], to_gates: Sequence[int], again: Sequence[int], *shapes, **rest) -> int:
    """Count the FLOPs of an LSTM.

    The arguments are the shapes of the operator's arguments: the inputs (n, B, inputs), the weights of the
    inputs (4 k, inputs), and the weights of the hidden state (4 k, k).
    """
    return 2 * x[0] * x[1] * (to_gates[0] * to_gates[1] + again[0] * again[1])


def _lstm_backward_flops(*shapes, **rest) -> int:
    """Count the FLOPs of the gradients of the weights and of the inputs; see `_lstm_flops`."""
    return 2 * _lstm_flops(*shapes, **rest)


_aten = torch.ops.aten
_CPU_FORMULAS = {
    _aten.mkldnn_rnn_layer: shape_wrapper(_lstm_flops),
    _aten.mkldnn_rnn_layer_backward: shape_wrapper(_lstm_backward_flops),
    # the same arguments as a GPU's kernel has; backward, the scores are computed again
    _aten._scaled_dot_product_flash_attention_for_cpu: flop_registry[
        _aten._scaled_dot_product_flash_attention
    ],
    _aten._scaled_dot_product_flash_attention_for_cpu_backward: flop_registry[
        _aten._scaled_dot_product_flash_attention_backward
    ],
}
