"""The device of a run: chosen by its name, checked, and described for the run's manifest; torch's threads."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch

from memmlp.common import distributed
from memmlp.common.errors import InputError

NVIDIA = Path("/dev/nvidiactl")  # made on Linux by the driver of NVIDIA's GPUs
OWN_THREADS = torch.get_num_threads()  # before any run has set another number


def device(name: str) -> torch.device:
    """Return the torch device with a given name: auto, cpu, cuda, cuda:INDEX or mps.

    The name auto stands for a CUDA GPU where there is one, else for the CPU. If several processes train one
    run together, each has the GPU whose index is the process's own number. On a GPU float32 stays float32:
    by default cuDNN rounds what GRUs and LSTMs multiply to TF32's ten bits.

    Raises:
        InputError: if there is no such device.
    """
    kind, _, index = name.partition(":")
    if kind == "mps" and not torch.backends.mps.is_available():
        raise InputError(f"device={name}: torch does not find an Apple GPU; use device=cpu")
    if kind in ("mps", "cpu"):
        return torch.device(kind)
    if not torch.cuda.is_available():
        if kind == "cuda":
            raise InputError(f"device={name}: torch does not find a CUDA device; use cpu or auto")
        return torch.device("cpu")
    torch.backends.cudnn.allow_tf32 = False
    if not index:
        return torch.device("cuda", distributed.local_rank())
    count = torch.cuda.device_count()
    if int(index) >= count:
        raise InputError(f"device={name}: must be cuda:0{f' to cuda:{count - 1}' * (count > 1)}")
    if distributed.world_size() > 1:
        raise InputError(f"device={name}: must be cuda with several processes, which have one GPU each")
    return torch.device("cuda", int(index))


def describe_device(used: torch.device) -> dict[str, Any]:
    """Return the facts of a device for a manifest: its kind, the GPU's name, and the GPU's index.

    The index, `gpu_index`, is the GPU's entry in CUDA_VISIBLE_DEVICES where that is set, since inside the
    process the visible GPUs are renumbered.
    """
    if used.type != "cuda":
        return {"device": used.type, "gpu": None, "gpu_index": None}
    index = torch.cuda.current_device() if used.index is None else used.index
    names = [name.strip() for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
    shown = names[index] if index < len(names) else str(index)
    return {"device": "cuda", "gpu": torch.cuda.get_device_name(used), "gpu_index": shown}


def use_threads(number: int) -> None:
    """Let torch use this many threads on the CPU; 0 for as many as it takes by itself.

    A process may perform several runs, one after another, so 0 undoes what an earlier run asked for.
    """
    torch.set_num_threads(number or OWN_THREADS)


def overlooked_gpu(name: str) -> str | None:
    """Return a warning if `auto` is the CPU of a machine with an NVIDIA GPU that is not hidden; else None."""
    hidden = os.environ.get("CUDA_VISIBLE_DEVICES", "all").strip() in ("", "-1")
    if name != "auto" or hidden or torch.cuda.is_available() or not NVIDIA.exists():
        return None
    return (
        f"device=auto: the CPU, since torch {torch.__version__} cannot use this machine's GPU; "
        "set device=cpu if this is intended"
    )


def missing_gpu() -> str | None:
    """Return an error if torch finds no GPU in a process that should have one; None if it does."""
    if torch.cuda.is_available():
        return None
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    state = "is not set" if visible is None else f"is '{visible}'"
    return (
        f"this worker needs a GPU, but torch {torch.__version__} finds none: CUDA_VISIBLE_DEVICES {state}; "
        "set device=cpu to train on the CPU"
    )
