"""What of a training of mixed precision (`optim.precision=bf16`) is computed in float32 all the same."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch


def in_float32(device: torch.device) -> AbstractContextManager[object]:
    """Compute in float32 what is inside, in a training of mixed precision too.

    Where precision is not mixed this is nothing, and nothing of it is in an exported graph.
    """
    mixed = torch.is_autocast_enabled(device.type)
    return torch.autocast(device.type, enabled=False) if mixed else nullcontext()
