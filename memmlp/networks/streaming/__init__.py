"""Streaming graphs: a trained network's live stream with nothing computed twice; same numbers, less work.

What depends on one frame alone is computed when the frame enters, and carried in the state. Of the last
layers only what the newest frame needs is computed.
"""

from __future__ import annotations

from memmlp.common.errors import InputError
from memmlp.networks.baselines.agrol import AGRoLDiffusion, AGRoLMLP
from memmlp.networks.baselines.avatar_poser import AvatarPoser
from memmlp.networks.mem_mlp import MemMLP
from memmlp.networks.streaming.baselines import AGRoLDiffusionStream, AGRoLMLPStream, AvatarPoserStream
from memmlp.networks.streaming.mem_mlp import MemMLPStream
from memmlp.networks.streaming.ring import StreamingGraph
from memmlp.networks.window_model import WindowModel

__all__ = ["StreamingGraph", "streaming"]

STREAMS: dict[type[WindowModel], type[StreamingGraph]] = {
    MemMLP: MemMLPStream,
    AvatarPoser: AvatarPoserStream,
    AGRoLMLP: AGRoLMLPStream,
    AGRoLDiffusion: AGRoLDiffusionStream,
}


def streaming(model: WindowModel) -> StreamingGraph:
    """Make the streaming graph of a trained network, which itself stays as it is.

    Raises:
        InputError: if the network has none: where estimates of past frames change at each step
            (`memory.history=latest`), nothing can be carried.
    """
    if not model.settled:
        raise InputError(
            "memory.history=latest: its estimates change at each step, which no streaming graph can carry; "
            "allowed is export.graph=naive, or memory.history=first"
        )
    return STREAMS[type(model)](model)
