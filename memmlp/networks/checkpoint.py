"""Tensors and JSON values in one safetensors file, written atomically and read without pickle."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write


def write(path: Path, tensors: dict[str, Tensor], values: dict[str, Any]) -> None:
    """Write tensors and JSON values atomically."""
    flat = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    atomic_write(path, save(flat, {"memmlp": json.dumps(values)}))


def read(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read the tensors and values that `write` wrote.

    Raises:
        InputError: if the file is missing or damaged; the message names it.
    """
    try:
        content = path.read_bytes()  # opened once, since a training may replace the file meanwhile
        tensors = load(content)
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        return tensors, json.loads(header["__metadata__"]["memmlp"])
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: not a checkpoint of memmlp ({error})") from error


def collect_module_tensors(prefix: str, module: nn.Module) -> dict[str, Tensor]:
    """Return a module's parameters and buffers; each name begins with "PREFIX."."""
    return {f"{prefix}.{name}": tensor for name, tensor in module.state_dict().items()}


def load_module(prefix: str, module: nn.Module, tensors: dict[str, Tensor]) -> None:
    """Load the tensors with names "PREFIX.…" into a module; see `collect_module_tensors`."""
    start = f"{prefix}."
    module.load_state_dict(
        {name.removeprefix(start): tensor for name, tensor in tensors.items() if name.startswith(start)}
    )


def collect_optimiser_tensors(optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Return the optimiser's state as tensors named "optimiser.PARAMETER_NUMBER.ENTRY"."""
    state = optimiser.state_dict()["state"]
    return {f"optimiser.{i}.{name}": tensor for i, entry in state.items() for name, tensor in entry.items()}


def load_optimiser(optimiser: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    """Load the optimiser's state; its parameter groups and learning rates stay unchanged."""
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        if name.startswith("optimiser."):
            _, index, entry = name.split(".", 2)
            state.setdefault(int(index), {})[entry] = tensor
    groups = optimiser.state_dict()["param_groups"]
    optimiser.load_state_dict({"state": state, "param_groups": groups})
