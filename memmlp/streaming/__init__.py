"""The live stream of a trained network with nothing computed twice: the same numbers, less work.

What depends on one frame alone is computed when the frame enters and carried in the state, and of the last
layers only what the newest frame needs is computed.
"""

from __future__ import annotations

from memmlp.errors import InputError
from memmlp.model import MemMLP, WindowModel
from memmlp.reference.agrol import AGRoLDiffusion, AGRoLMLP
from memmlp.reference.avatar_poser import AvatarPoser
from memmlp.streaming.mem_mlp import MemMLPStream
from memmlp.streaming.reference import AGRoLDiffusionStream, AGRoLMLPStream, AvatarPoserStream
from memmlp.streaming.ring import Stream

__all__ = ["Stream", "has_stream", "streaming"]

STREAMS: dict[type[WindowModel], type[Stream]] = {
    MemMLP: MemMLPStream,
    AvatarPoser: AvatarPoserStream,
    AGRoLMLP: AGRoLMLPStream,
    AGRoLDiffusion: AGRoLDiffusionStream,
}


def has_stream(model: WindowModel) -> bool:
    """Whether a network has a live stream of its own: unless what it recalls of a frame changes with time."""
    return not isinstance(model, MemMLP) or model.memory.settled


def streaming(model: WindowModel) -> Stream:
    """The live stream of a trained network, which itself stays as it is.

    Raises InputError where there is none: where estimates of past frames change at each step
    (`memory.history=latest`), nothing can be carried.
    """
    if not has_stream(model):
        raise InputError(
            "memory.history=latest: its estimates change at each step, which no streaming graph can carry; "
            "allowed is export.graph=naive, or memory.history=first"
        )
    return STREAMS[type(model)](model)
