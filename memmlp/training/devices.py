"""Choose and describe a run's device, and set torch's number of threads."""

import os
from pathlib import Path
from typing import Any

import torch

from memmlp.common import distributed
from memmlp.common.errors import InputError
from memmlp.common.processes import count_usable_cores

NVIDIA_DRIVER = Path("/dev/nvidiactl")  # made on Linux by the driver of NVIDIA's GPUs
DEFAULT_THREADS = min(torch.get_num_threads(), count_usable_cores())  # before any run has set another number


def choose_device(name: str) -> torch.device:
    """Return the torch device with a name: auto (a CUDA GPU if there is one), cpu, cuda, cuda:INDEX or mps.
    If several processes train one run together, process N uses GPU N. On a GPU, TF32 is switched off: by
    default cuDNN rounds the factors in GRUs and LSTMs to ten bits. Raises InputError if the device does not
    exist."""
    kind, _, index = name.partition(":")
    if kind == "mps" and not torch.backends.mps.is_available():
        raise InputError(f"device={name}: must be cpu or auto, since torch does not find an Apple GPU")
    if kind in ("mps", "cpu"):
        return torch.device(kind)
    if not torch.cuda.is_available():
        if kind == "cuda":
            raise InputError(f"device={name}: must be cpu or auto, since torch does not find a CUDA device")
        return torch.device("cpu")
    torch.backends.cudnn.allow_tf32 = False
    if not index:
        return torch.device("cuda", distributed.local_rank())
    count = torch.cuda.device_count()
    if int(index) >= count:
        raise InputError(f"device={name}: must be cuda:0{f' to cuda:{count - 1}' * (count > 1)}")
    if distributed.world_size() > 1:
        raise InputError(f"device={name}: must be cuda with several processes, so that each uses its own GPU")
    return torch.device("cuda", int(index))


def describe_device(device: torch.device) -> dict[str, Any]:
    """Return a device's kind, GPU name and GPU index for a manifest. If CUDA_VISIBLE_DEVICES is set,
    `gpu_index` is the GPU's entry there, because the process renumbers the visible GPUs."""
    if device.type != "cuda":
        return {"device": device.type, "gpu": None, "gpu_index": None}
    index = torch.cuda.current_device() if device.index is None else device.index
    names = [name.strip() for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
    shown = names[index] if index < len(names) else str(index)
    return {"device": "cuda", "gpu": torch.cuda.get_device_name(device), "gpu_index": shown}


def use_threads(number: int) -> None:
    """Set torch's number of CPU threads; 0 restores torch's default."""
    torch.set_num_threads(number or DEFAULT_THREADS)


def describe_unused_gpu(name: str) -> str | None:
    """Return a warning if `auto` selects the CPU although the machine has a visible NVIDIA GPU; else None."""
    hidden = os.environ.get("CUDA_VISIBLE_DEVICES", "all").strip() in ("", "-1")
    if name != "auto" or hidden or torch.cuda.is_available() or not NVIDIA_DRIVER.exists():
        return None
    return (
        f"device=auto: uses the CPU, since torch {torch.__version__} cannot use this machine's GPU; "
        "set device=cpu if this is intended"
    )


def describe_missing_gpu() -> str | None:
    """Return an error message if torch does not find a GPU; None if it finds one."""
    if torch.cuda.is_available():
        return None
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    state = "is not set" if visible is None else f"is '{visible}'"
    return (
        f"this worker needs a GPU, but torch {torch.__version__} does not find one (CUDA_VISIBLE_DEVICES "
        f"{state}); set device=cpu to train on the CPU"
    )
