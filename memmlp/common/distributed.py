"""Data-parallel training of one run by several processes, which torchrun starts.

Every process draws the whole batch of each step from the same seed, and works on its own rows. The gradients
are averaged over all processes, so the run equals a run of a single process. Without torchrun there is one
process, and the functions here have no effect.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator
from datetime import timedelta
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from torch import Tensor, nn

T = TypeVar("T")

TIMEOUT = timedelta(days=7)  # others wait while the first process prepares, validates or evaluates


_split = False
"""Whether this process works on its own rows of a batch."""


def world_size() -> int:
    """Return the number of processes that train the run; 1 without torchrun."""
    return int(os.environ["WORLD_SIZE"]) if "TORCHELASTIC_RUN_ID" in os.environ else 1


def rank() -> int:
    """Return the rank of this process among all processes."""
    return int(os.environ["RANK"]) if world_size() > 1 else 0


def local_rank() -> int:
    """Return the rank of this process among the processes on its machine; it is also the index of its GPU."""
    return int(os.environ["LOCAL_RANK"]) if world_size() > 1 else 0


def is_first() -> bool:
    """Return whether this process has rank 0; only this one writes files."""
    return rank() == 0


def connect(kind: str) -> None:
    """Connect this process to the others, unless it is connected; `kind` is a device type, such as "cuda"."""
    from torch import distributed

    if world_size() == 1 or distributed.is_initialized():
        return
    if kind == "cuda":
        import torch

        torch.cuda.set_device(local_rank())
    distributed.init_process_group("nccl" if kind == "cuda" else "gloo", timeout=TIMEOUT)


def disconnect() -> None:
    """Disconnect from the other processes, after waiting for all: otherwise a late receiver would abort."""
    if world_size() > 1:
        from torch import distributed

        distributed.barrier()
        distributed.destroy_process_group()


def broadcast(value: T) -> T:
    """Return the first process' value in all processes; every process must call this."""
    if world_size() == 1:
        return value
    from torch import distributed

    values: list[Any] = [value]
    distributed.broadcast_object_list(values, src=0)
    return values[0]


@contextlib.contextmanager
def split_batch() -> Iterator[None]:
    """In this context, batches are split: each process works on its own rows."""
    global _split
    _split = world_size() > 1
    try:
        yield
    finally:
        _split = False


def is_batch_split() -> bool:
    """Return whether this process works on its own rows of a batch, inside `split_batch()`."""
    return _split


def take_local_rows(batch: Tensor) -> Tensor:
    """Return this process' rows of a whole batch (B, ...); B is a multiple of the number of processes."""
    return batch.chunk(world_size())[rank()] if _split else batch


def gather_rows(rows: Tensor) -> Tensor:
    """Concatenate the rows (b, ...) of all processes to the whole batch (B, ...), without gradients."""
    if not _split:
        return rows
    import torch
    from torch import distributed

    parts = [torch.empty_like(rows, memory_format=torch.contiguous_format) for _ in range(world_size())]
    distributed.all_gather(parts, rows.detach().contiguous())
    return torch.cat(parts)


def draw_rows(draw: Callable[[Tensor], Tensor], like: Tensor) -> Tensor:
    """Draw random numbers for the whole batch, like a single process would, and return this process' rows.
    `draw` gets a tensor with the shape of the whole batch; `like` has the shape (b, ...) of these rows."""
    if not _split:
        return draw(like)
    return take_local_rows(draw(like.detach().repeat(world_size(), *[1] * (like.dim() - 1))))


def average(values: Tensor) -> Tensor:
    """Return a tensor's mean over all processes; each has the same number of rows."""
    if world_size() == 1:
        return values
    from torch import distributed

    total = values.detach().clone()
    distributed.all_reduce(total)
    return total / world_size()


def average_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Replace each gradient by its mean over all processes."""
    if world_size() == 1:
        return
    import torch

    gradients = [one.grad for one in parameters if one.grad is not None]
    means = average(torch.cat([grad.flatten() for grad in gradients]))
    for grad, part in zip(gradients, means.split([grad.numel() for grad in gradients]), strict=True):
        grad.copy_(part.view_as(grad))


def copy_from_first(module: nn.Module) -> None:
    """Copy the first process' parameters and buffers to all processes, so that they can't drift apart."""
    if world_size() == 1:
        return
    from torch import distributed

    for tensor in module.state_dict().values():
        distributed.broadcast(tensor, src=0)
