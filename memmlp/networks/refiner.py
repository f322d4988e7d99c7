"""The refiner slot: a refiner corrects the stream of a network's poses, frame by frame.

SAGE-Net's refiner (Feng et al., CVPR 2024) is a recurrent network behind its decoder. Here it can follow any
network. It is trained on the poses that the trained network streams (memmlp.training.train_refiner).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from memmlp.common.components import component
from memmlp.common.settings import Settings, at_least, one_of, positive, setting
from memmlp.motion.body import POSITION, ROTATION
from memmlp.motion.normalizer import Normalizer, use_float32
from memmlp.networks.motion_model import MotionModel, State, StreamingGraph
from memmlp.networks.settings import Release
from memmlp.networks.streaming import FrameGRU, has_streaming_graph, make_streaming_graph

HIDDEN = "refiner"  # the name of the refiner's own state


@component("refiner", "sage")
@dataclass
class SAGERefinerSettings(Settings):
    """SAGE-Net's refiner (Feng et al. 2024): recurrent layers that correct a stream of rotations.

    It is trained on poses that the trained network streams; the network's run is shared with experiments
    without a refiner. The loss follows the released code. The refiner may move arms off the hands' trackers;
    evaluation.ik=arms moves them back. Steps, batch (in pieces) and schedule come from optim.
    """

    width: int = setting(at_least(1), tiny=8, small=96, paper=512)  # the width of the recurrent layers
    depth: int = setting(at_least(1), 2)  # number of recurrent layers
    frames: int = setting(at_least(4), tiny=20, small=120, paper=500)  # number of frames in a training piece
    # number of pieces to draw from the training clips (see data.drawn_by); short clips are padded by
    # repeating the first frame
    pieces: int = setting(at_least(1), tiny=8, small=512, paper=2048)
    velocities: str = setting(one_of("rotations", "joints"), "rotations")  # what the velocity loss compares
    lr: float | None = setting(positive(), None)  # initial learning rate; null: optim.lr

    release: ClassVar = Release(
        source="Wenchao-M/SAGE 07415ac",
        names={"layers.*": "refine_net.*", "head.*": "linear.*"},
        sizes={
            "refiner.width": ("refine_net.weight_hh_l0", 1),
            "refiner.depth": "refine_net.weight_ih_l*",
        },
    )

    def build(self, network: MotionModel) -> RefinedModel:
        """Add a refiner with random weights behind a network."""
        return RefinedModel(network, self.width, self.depth)


class RefinedGraph(StreamingGraph):
    """The network's streaming graph, followed by a step of the refiner's recurrent layers."""

    model: RefinedModel

    @classmethod
    def fits(cls, model: Any) -> bool:
        """Return whether the network in front of the refiner has a streaming graph."""
        return has_streaming_graph(model.network)

    def build(self, model: Any) -> None:
        self.model, self.hidden = model, model.initial_state(1)[HIDDEN]
        self.graph = make_streaming_graph(model.network)
        model.add_module("layers", FrameGRU(model.layers))  # of another class than the network's
        inner = (f"graph.{name}" for name in self.graph.float32_modules)
        self.float32_modules = (*inner, "model.layers", "model.head")

    def windows(self) -> State:
        """Return zeros for the state of the network's graph, and for the hidden state (1, depth, width)."""
        return {**self.graph.windows(), HIDDEN: self.hidden}

    def step(self, sparse: Tensor, state: State, is_first_step: Tensor) -> tuple[Tensor, State]:
        motion, kept = self.graph.step(sparse, state, is_first_step)
        refined, hidden = self.model.refine(motion[None], sparse[None], state[HIDDEN])
        return refined[0], {**kept, HIDDEN: hidden}


class RefinedModel(MotionModel):
    """A network followed by recurrent layers that correct its rotations; a stream in both evaluation modes.

    With 2 layers of width 512 the refiner has 2,635,908 parameters. Rotations are corrected in the world.
    Learned positions stay unchanged; other positions follow from the corrected rotations. Networks that put
    hands on their trackers (RecurrentPoser, MANIKIN) lose this; `evaluation.ik=arms` restores it.

    Args:
        network: the network; it is not trained further.
        width: the width of the recurrent layers (GRU).
        depth: number of recurrent layers.
    """

    graph = RefinedGraph
    windowless = True

    def __init__(self, network: MotionModel, width: int, depth: int):
        nn.Module.__init__(self)
        self.network, self.frames, self.branches = network, network.frames, network.branches
        self.settled, self.is_stream = network.settled, network.is_stream
        self.layers = nn.GRU(ROTATION.stop, width, depth, batch_first=True)
        self.head = nn.Linear(width, ROTATION.stop)

    @property
    def normalizer(self) -> Normalizer:  # type: ignore[override]
        """The network's normalizer."""
        return self.network.normalizer

    def count_parameters(self) -> int:
        """Return the number of parameters of network and refiner."""
        own = (p.numel() for part in (self.layers, self.head) for p in part.parameters())
        return self.network.count_parameters() + sum(own)

    @property
    def past_frames(self) -> int:
        return self.network.past_frames

    def initial_state(self, batch: int = 1) -> State:
        """Return the initial state, zeros: the network's state, and the hidden state (B, depth, width)."""
        hidden = torch.zeros(batch, self.layers.num_layers, self.layers.hidden_size)
        return {**self.network.initial_state(batch), HIDDEN: hidden.to(self.normalizer.mean)}

    def running_state(self, sparse: Tensor) -> State:
        return self.initial_state(len(sparse)) | self.network.running_state(sparse)

    def true_state(self, frames: Tensor) -> State:
        """Return the state after world frames (B, past, 252), without earlier corrections."""
        return self.initial_state(len(frames)) | self.network.true_state(frames)

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        """Process the newest frames one after the other; see MotionModel.

        By default the n new frames are returned, which is the maximum for this network.
        """
        motions, kept = [], {name: tensor for name, tensor in state.items() if name != HIDDEN}
        for frame in sparse.split(1, 1):
            motion, kept = self.network.advance(frame, kept, 1)
            motions.append(motion)
        refined, hidden = self.refine(torch.cat(motions, 1), sparse, state[HIDDEN])
        count = sparse.shape[1] if newest is None else newest
        return refined[:, -count:], {**kept, HIDDEN: hidden}

    def refine(self, motion: Tensor, sparse: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Correct the motion of consecutive frames.

        Args:
            motion: the network's motion (B, n, 198), world.
            sparse: world inputs (B, n, 54).
            hidden: hidden states (B, depth, width) before these frames.

        Returns:
            Motion (B, n, 198), and the new hidden states.
        """
        rotation = motion[..., ROTATION]
        with use_float32(motion.device):
            features, after = self.layers(rotation, hidden.transpose(0, 1).contiguous())
        rotation = rotation + self.head(features)
        positions = motion[..., POSITION]
        if "position" not in self.branches:
            refined = torch.cat([rotation, positions], -1).detach()
            positions = self.normalizer.compute_positions(refined, sparse).flatten(-2)
        return torch.cat([rotation, positions], -1), after.transpose(0, 1)
