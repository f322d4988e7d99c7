"""Streaming graphs, from which the live step is exported: a network that computes nothing twice.

What depends on one frame alone is computed when the frame enters the window, and carried in the state. The
last layers compute only what the newest frame needs.
"""

from __future__ import annotations

from memmlp.common.errors import InputError
from memmlp.networks.baselines.agrol import AGRoLDiffusion, AGRoLMLP
from memmlp.networks.baselines.avatar_jlm import AvatarJLM
from memmlp.networks.baselines.avatar_poser import AvatarPoser
from memmlp.networks.baselines.bodiffusion import BoDiffusion
from memmlp.networks.baselines.ego_poser import EgoPoser
from memmlp.networks.baselines.hmd_poser import HMDPoser
from memmlp.networks.baselines.manikin import ManikinL, ManikinS
from memmlp.networks.baselines.rpm import RPM
from memmlp.networks.baselines.sage_net import SAGENet
from memmlp.networks.baselines.still_pose import StillPose
from memmlp.networks.baselines.vae_hmd import VAEHMD
from memmlp.networks.mem_mlp import MemMLP
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.recurrent_poser import RecurrentPoser
from memmlp.networks.refiner import Refined
from memmlp.networks.streaming.baselines import (
    AGRoLDiffusionGraph,
    AGRoLMLPGraph,
    AvatarJLMGraph,
    AvatarPoserGraph,
    EgoPoserGraph,
    HMDPoserGraph,
    ManikinLGraph,
    ManikinSGraph,
    RPMGraph,
    StillPoseGraph,
    VAEHMDGraph,
)
from memmlp.networks.streaming.bodiffusion import BoDiffusionGraph
from memmlp.networks.streaming.graph import StreamingGraph
from memmlp.networks.streaming.mem_mlp import MemMLPGraph
from memmlp.networks.streaming.recurrent_poser import RecurrentPoserGraph
from memmlp.networks.streaming.refined import RefinedGraph
from memmlp.networks.streaming.sage_net import SAGENetGraph

__all__ = ["StreamingGraph", "check_streams", "has_stream", "streaming"]

STREAMS: dict[type[MotionModel], type[StreamingGraph]] = {
    MemMLP: MemMLPGraph,
    AvatarPoser: AvatarPoserGraph,
    EgoPoser: EgoPoserGraph,
    HMDPoser: HMDPoserGraph,
    AvatarJLM: AvatarJLMGraph,
    RPM: RPMGraph,
    VAEHMD: VAEHMDGraph,
    StillPose: StillPoseGraph,
    RecurrentPoser: RecurrentPoserGraph,
    ManikinS: ManikinSGraph,
    ManikinL: ManikinLGraph,
    AGRoLMLP: AGRoLMLPGraph,
    AGRoLDiffusion: AGRoLDiffusionGraph,
    BoDiffusion: BoDiffusionGraph,
    SAGENet: SAGENetGraph,
}


def streaming(model: MotionModel) -> StreamingGraph:
    """Make the streaming graph of a trained network, without changing the network.

    Raises:
        InputError: if the network has no streaming graph: estimates of past frames change at each step
            (`memory.history=latest`), so nothing can be carried; frames are made with later ones, so it is no
            stream; or a custom part has no graph.
    """
    if not model.settled:
        raise InputError(
            "export.graph=streaming: estimates of past frames change at each step (memory.history=latest, or "
            "a memory of one's own), which no such graph can carry; allowed is export.graph=naive, or "
            "memory.history=first"
        )
    check_streams(model)
    if not has_stream(model):
        raise InputError(
            "export.graph=streaming: a part of one's own has none; allowed is export.graph=naive"
        )
    if isinstance(model, Refined):
        return RefinedGraph(model, streaming(model.network))
    return STREAMS[type(model)](model)


def check_streams(model: MotionModel) -> None:
    """Raise InputError for a network that makes frames with later ones: no live step makes its motion."""
    if not model.is_stream:
        raise InputError("model.offline=true: makes frames with later ones; allowed is model.offline=false")


def has_stream(model: MotionModel) -> bool:
    """Return whether there is a streaming graph for a network; custom parts may have none."""
    if isinstance(model, Refined):
        return has_stream(model.network)
    graph = STREAMS.get(type(model))
    return graph is not None and model.settled and model.is_stream and graph.fits(model)
