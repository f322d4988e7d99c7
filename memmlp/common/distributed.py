"""Data-parallel training of one run by several processes, as torchrun starts them.

Every process draws the whole batch of a step, from the same seed, and works on its own rows. The gradients
are averaged over all processes, so the run is the same as one trained by a single process. Without torchrun
there is one process, and the functions here have no effect.
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


class _Step:
    """The state of this process: whether it works on its share of a batch."""

    shared = False


def world_size() -> int:
    """Return how many processes train the run; 1 without torchrun."""
    return int(os.environ["WORLD_SIZE"]) if "TORCHELASTIC_RUN_ID" in os.environ else 1


def rank() -> int:
    """Return this process' number among all."""
    return int(os.environ["RANK"]) if world_size() > 1 else 0


def local_rank() -> int:
    """Return this process' number among those on its machine, which is also the index of its GPU."""
    return int(os.environ["LOCAL_RANK"]) if world_size() > 1 else 0


def is_first() -> bool:
    """Return whether this process is the first, which writes files."""
    return rank() == 0


def connect(kind: str) -> None:
    """Join the other processes, unless that was done before; `kind` is the device's kind, such as "cuda"."""
    from torch import distributed

    if world_size() == 1 or distributed.is_initialized():
        return
    if kind == "cuda":
        import torch

        torch.cuda.set_device(local_rank())
    distributed.init_process_group("nccl" if kind == "cuda" else "gloo", timeout=TIMEOUT)


def disconnect() -> None:
    """Leave the other processes once all have received the last message; otherwise a late receiver aborts."""
    if world_size() > 1:
        from torch import distributed

        distributed.barrier()
        distributed.destroy_process_group()


def broadcast(value: T) -> T:
    """Send the first process' value to all processes, and return it in each; all have to call this."""
    if world_size() == 1:
        return value
    from torch import distributed

    carried: list[Any] = [value]
    distributed.broadcast_object_list(carried, src=0)
    return carried[0]


@contextlib.contextmanager
def share_batch() -> Iterator[None]:
    """Within this context, tensors are this process' share of a batch, if there are several processes."""
    _Step.shared = world_size() > 1
    try:
        yield
    finally:
        _Step.shared = False


def is_shared() -> bool:
    """Return whether this process is working on its share of a batch, inside `share_batch()`."""
    return _Step.shared


def local_rows(batch: Tensor) -> Tensor:
    """Return this process' rows of a whole batch (B, ...); the number of processes divides B."""
    return batch.chunk(world_size())[rank()] if _Step.shared else batch


def gather_rows(rows: Tensor) -> Tensor:
    """Return the rows (b, ...) of all processes together (B, ...), without gradients."""
    if not _Step.shared:
        return rows
    import torch
    from torch import distributed

    parts = [torch.empty_like(rows, memory_format=torch.contiguous_format) for _ in range(world_size())]
    distributed.all_gather(parts, rows.detach().contiguous())
    return torch.cat(parts)


def draw_rows(draw: Callable[[Tensor], Tensor], like: Tensor) -> Tensor:
    """Draw random numbers for the whole batch, as a single process does, and return this process' rows.

    Args:
        draw: draws, given a tensor with the shape of the whole batch.
        like: this process' rows (b, ...) of that tensor; its values are not used for the other rows.
    """
    if not _Step.shared:
        return draw(like)
    return local_rows(draw(like.detach().repeat(world_size(), *[1] * (like.dim() - 1))))


def average(values: Tensor) -> Tensor:
    """Return a tensor's mean over all processes, whose shares of the batch are equally large."""
    if world_size() == 1:
        return values
    from torch import distributed

    total = values.detach().clone()
    distributed.all_reduce(total)
    return total / world_size()


def average_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Replace the gradients by their means over all processes."""
    if world_size() == 1:
        return
    import torch

    found = [one.grad for one in parameters if one.grad is not None]
    means = average(torch.cat([grad.flatten() for grad in found]))
    for grad, part in zip(found, means.split([grad.numel() for grad in found]), strict=True):
        grad.copy_(part.view_as(grad))


def copy_from_first(module: nn.Module) -> None:
    """Copy the first process' parameters and buffers to all processes, so that they can't drift apart."""
    if world_size() == 1:
        return
    from torch import distributed

    for tensor in module.state_dict(keep_vars=False).values():
        distributed.broadcast(tensor, src=0)
