"""Tensors and JSON values in one safetensors file, written atomically and read without pickle."""

from __future__ import annotations

import json
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write


def write(path: Path, tensors: dict[str, Tensor], values: dict[str, Any]) -> None:
    """Write tensors and JSON values; a kill at any moment leaves the old file or the new one."""
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


def module_tensors(prefix: str, module: nn.Module) -> dict[str, Tensor]:
    """Return the parameters and buffers of a module, their names preceded by "PREFIX."."""
    return {f"{prefix}.{name}": tensor for name, tensor in module.state_dict().items()}


def load_module(prefix: str, module: nn.Module, tensors: dict[str, Tensor]) -> None:
    """Load into a module those of the tensors that `module_tensors` named with this prefix."""
    own = {name.removeprefix(f"{prefix}."): t for name, t in tensors.items() if name.startswith(f"{prefix}.")}
    known = module.state_dict().keys()
    module.load_state_dict({_current(name, known): tensor for name, tensor in own.items()})


WEIGHTS = (
    ("rotation", "rotation_all"),
    ("position", "position_branch"),
    ("position", "position_from_pelvis"),
    ("velocity", "velocity_lower_body"),
)
"""Terms of losses by their names up to version 0.2 and the present ones, of Mem-MLP's and the library's.

They sort alike: torch keeps the learned weights by their names, and the optimiser's state by their order.
"""


def _current(name: str, known: Collection[str]) -> str:
    """Return the name that a tensor has in this version.

    Version 0.1 called the normalizer `frame`; the learned weights of a loss have the terms' names.
    """
    name = re.sub(r"(^|\.)frame\.(rest|mean|std)$", r"\1normalizer.\2", name)
    above, _, term = name.rpartition(".")
    renamed = (f"{above}.{now}" for former, now in WEIGHTS if former == term and name not in known)
    return next((one for one in renamed if one in known), name)


def optimiser_tensors(optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Return the optimiser's state as tensors named "optimiser.PARAMETER_NUMBER.ENTRY"."""
    state = optimiser.state_dict()["state"]
    return {f"optimiser.{i}.{name}": tensor for i, entry in state.items() for name, tensor in entry.items()}


def load_optimiser(optimiser: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    """Load the optimiser's state; its parameter groups, and so their learning rates, stay as they are."""
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        if name.startswith("optimiser."):
            _, index, entry = name.split(".", 2)
            state.setdefault(int(index), {})[entry] = tensor
    groups = optimiser.state_dict()["param_groups"]
    optimiser.load_state_dict({"state": state, "param_groups": groups})
