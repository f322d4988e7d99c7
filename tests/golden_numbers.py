"""How the numbers of a component are summed up, and compared."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

Numbers = dict[str, float]


def summary(name: str, values: Tensor) -> Numbers:
    """Four numbers of a tensor that hardly any change of it leaves as they were."""
    flat = values.detach().double().flatten()
    ramp = torch.linspace(-1, 1, len(flat), dtype=torch.double)
    return {
        f"{name} mean": float(flat.mean()),
        f"{name} size": float(flat.abs().mean()),
        f"{name} spread": float(flat.square().mean()),
        f"{name} tilt": float((flat * ramp).mean()),
    }


def changed(now: Mapping[str, float], before: Mapping[str, float], tolerance: float) -> list[str]:
    """The names of the numbers that are not what they were, beyond what processors differ by."""
    close = {
        name: np.isclose(now[name], before[name], rtol=tolerance, atol=1e-2 * tolerance)
        for name in now.keys() & before.keys()
    }
    return sorted((now.keys() ^ before.keys()) | {name for name, same in close.items() if not same})


def tolerance(case: str) -> float:
    """How far processors' numbers may differ: where few bits are left, they round by one more or less."""
    return 2e-2 if case in ("int8", "int8_blocks", "fp16", "optim.muon") else 2e-4
