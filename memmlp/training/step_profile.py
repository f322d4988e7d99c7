"""Where the time of a training step goes on a CPU, measured by torch's profiler."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch.profiler import ProfilerActivity, profile, record_function

SAMPLING = "sampling"
"""What the drawing of a batch is called in a profile (memmlp.training.train_network)."""

MATRIX_PRODUCTS = frozenset(
    f"aten::{name}"
    for name in (
        "mm", "addmm", "bmm", "baddbmm", "addmv", "mv", "_addmm_activation", "mkldnn_linear",
        "mkldnn_convolution", "mkldnn_convolution_backward", "_slow_conv2d_forward", "_slow_conv2d_backward",
        "mkldnn_rnn_layer", "mkldnn_rnn_layer_backward", "_scaled_dot_product_flash_attention_for_cpu",
        "_scaled_dot_product_flash_attention_for_cpu_backward",
    )
)  # fmt: skip
"""Kernels that are matrix products, or mostly: those of recurrences and of attention are one kernel."""

PHASES = ("matrix products", "other kernels", "optimiser", SAMPLING, "rest")
"""The parts of a step.

Optimiser and sampling are all that happens in them. The rest is Python, autograd's own time, and what
torch.compile made.
"""


def step_phases(take: Callable[[int], None], steps: int) -> dict[str, float]:
    """Return how long each of PHASES takes in a step, in milliseconds; they add up to a profiled step.

    The profiler itself takes time for each operation, so a profiled step is longer than another one. Matrix
    products, which are few and long, are affected least.

    Args:
        take: takes the given number of training steps.
        steps: how many steps to profile.
    """
    with profile(activities=[ProfilerActivity.CPU]) as profiled, record_function("steps"):
        take(steps)
    parts = dict.fromkeys(PHASES, 0.0)
    for event in profiled.events() or ():
        parts[_part(event)] += event.self_cpu_time_total / 1000 / steps
    return parts


def _part(event: Any) -> str:
    """Return the part to which an event's own time belongs."""
    inside, above = [event.name], event.cpu_parent
    while above is not None:
        inside.append(above.name)
        above = above.cpu_parent
    if SAMPLING in inside:
        return SAMPLING
    if any(name.startswith("Optimizer.") for name in inside):
        return "optimiser"
    if event.name in MATRIX_PRODUCTS:
        return "matrix products"
    return "other kernels" if event.name.startswith("aten::") else "rest"
