"""Parts of a mixed-precision training (`optim.precision=bf16`) that are computed in float32."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch


def in_float32(device: torch.device) -> AbstractContextManager[object]:
    """Compute in float32 within the context, even in a mixed-precision training.

    Without mixed precision it has no effect, and it leaves nothing in an exported graph.
    """
    mixed = torch.is_autocast_enabled(device.type)
    return torch.autocast(device.type, enabled=False) if mixed else nullcontext()
