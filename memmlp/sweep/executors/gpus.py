"""The GPUs of this machine, shared out among its workers."""

from __future__ import annotations

import itertools
import os

from memmlp.common.errors import InputError

VISIBLE = "CUDA_VISIBLE_DEVICES"

Share = tuple[str, ...]
"""The GPUs of one worker, by their names in CUDA_VISIBLE_DEVICES; empty for a worker without GPUs."""


def visible_gpus() -> Share:
    """Return the names of the GPUs that this process may use, in the form of CUDA_VISIBLE_DEVICES.

    As in CUDA, a name below 0 hides that entry and all that follow.
    """
    words = os.environ.get(VISIBLE)
    if words is None:
        import torch

        return tuple(map(str, range(torch.cuda.device_count())))
    names = [word.strip() for word in words.split(",") if word.strip()]
    return tuple(itertools.takewhile(lambda name: not name.startswith("-"), names))


def shares(gpus: Share, per_worker: int | None = None) -> list[Share]:
    """Divide the GPUs into shares of `per_worker` GPUs, one share for each worker; a remainder is idle.

    Args:
        gpus: the visible GPUs.
        per_worker: GPUs of a worker; None for 1 if there are GPUs. With 0 there are no shares.

    Raises:
        InputError: if a worker would have more GPUs than there are.
    """
    size = per_worker if per_worker is not None else min(len(gpus), 1)
    if size > len(gpus):
        there = f"visible here is {', '.join(gpus) or 'no GPU'}"
        raise InputError(f"--gpus-per-worker {size}: allowed is up to {len(gpus)}; {there}")
    return [gpus[i : i + size] for i in range(0, len(gpus) - size + 1, size)] if size else []


def worker_count(shared: list[Share], workers: int | None, per_gpu: int | None) -> int:
    """Return how many workers run at once.

    Args:
        shared: the shares of GPUs that a worker may get; empty if workers have no GPUs.
        workers: how many were asked for; None for one per core, or with GPUs one per share.
        per_gpu: the largest number of workers per share; None for as many as are needed.

    Raises:
        InputError: if that is more than the shares allow, or if there are no GPUs to share.
    """
    if per_gpu and not shared:
        raise InputError(
            f"--workers-per-gpu {per_gpu}: allowed where workers have GPUs; here is none for them"
        )
    if not shared:
        return workers or os.cpu_count() or 1
    most = len(shared) * (per_gpu or 1)
    if workers and per_gpu and workers > most:
        raise InputError(f"--workers {workers}: allowed is up to {most}, with --workers-per-gpu {per_gpu}")
    return workers or most
