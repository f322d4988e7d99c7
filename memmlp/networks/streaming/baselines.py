"""The streaming graphs of AvatarPoser, MANIKIN, EgoPoser, AGRoL, HMD-Poser, VAE-HMD, RPM and AvatarJLM.

Networks with a window read only the newest frame of their last layers' output, so the last layer computes
that frame alone, and what their first layers compute from one frame alone is carried.
"""

from __future__ import annotations

from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor

from memmlp.motion.body import ROTATION, SPARSE_DIM
from memmlp.networks.baselines.agrol import AGRoLDiffusion, AGRoLMLP, TimedBlock
from memmlp.networks.baselines.avatar_jlm import TOKENS, AvatarJLM
from memmlp.networks.baselines.avatar_poser import AvatarPoser
from memmlp.networks.baselines.ego_poser import PLACES, EgoPoser, beside_head, places
from memmlp.networks.baselines.hmd_poser import HMDPoser
from memmlp.networks.baselines.manikin import ManikinL, ManikinS
from memmlp.networks.baselines.rpm import RPM
from memmlp.networks.baselines.still_pose import StillPose
from memmlp.networks.baselines.transformer_encoder import EncoderLayer
from memmlp.networks.baselines.vae_hmd import VAEHMD
from memmlp.networks.layers import MLPBlock
from memmlp.networks.memory import State
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.streaming.graph import StreamingGraph, filled, slid
from memmlp.networks.windowless_model import WindowlessModel


class AvatarPoserGraph(StreamingGraph):
    """AvatarPoser's streaming graph."""

    float32_modules: tuple[str, ...] = ("model.embedding", "model.orientation", "model.rotation")
    model: AvatarPoser
    layers: list[EncoderLayer]

    def build(self, model: MotionModel) -> None:
        """Make the graph's parts from a copy of the network."""
        assert isinstance(model, AvatarPoser)
        self.model, self.layers = model, cast(list[EncoderLayer], list(model.layers))

    def windows(self) -> State:
        """Return zeros (T, 4 d): each frame's embedding and first query, key and value, side by side."""
        return {"first": torch.zeros(self.frames, 4 * self.model.embedding.out_features)}

    def step(self, sparse: Tensor, state: State, fresh: Tensor) -> tuple[Tensor, State]:
        """Map world inputs (1, 54) and the state to world motion (1, 198) and the new state."""
        encoded = self.normalizer.encode_sparse(sparse, self.normalizer.origin(sparse))
        embedded = self.model.embedding(encoded)
        *earlier, last = self.layers
        attention = self.layers[0].attention
        entering = torch.cat(
            [embedded, attention.query(embedded), attention.key(embedded), attention.value(embedded)], -1
        )
        first = slid(state["first"], entering, entering, fresh)
        h, query, key, value = first.chunk(4, -1)
        for layer, following in zip(earlier, self.layers[1:], strict=True):
            h = layer.finish(h, layer.attention.attend(query[None], key[None], value[None])[0])
            attention = following.attention
            query, key, value = attention.query(h), attention.key(h), attention.value(h)
        attended = last.attention.attend(query[-1:][None], key[None], value[None])[0]
        features = last.finish(h[-1:], attended)
        return self.normalizer.posed(self.rotation(features, encoded), sparse), {"first": first}

    def rotation(self, newest: Tensor, encoded: Tensor) -> Tensor:
        """Map the newest frame's feature (1, d) and inputs (1, 54) to its rotations (1, 132)."""
        return self.model.read(newest)


class ManikinSGraph(AvatarPoserGraph):
    """MANIKIN-S' streaming graph: AvatarPoser's graph, then the solver of the newest frame's limbs."""

    float32_modules = (*AvatarPoserGraph.float32_modules, "model.swivel", "model.places")
    model: ManikinS

    def rotation(self, newest: Tensor, encoded: Tensor) -> Tensor:
        """Map the newest frame's feature (1, d) and inputs (1, 54) to its rotations (1, 132)."""
        return self.model.posed(self.model.read(newest), encoded)


def newest_frame(layers: list[EncoderLayer], h: Tensor) -> Tensor:
    """Apply encoder layers to features (T, d); the last layer computes the newest frame (1, d) alone."""
    *earlier, last = layers
    for layer in earlier:
        h = layer(h)
    attention, newest = last.attention, h[-1:]
    return last.finish(
        newest, attention.attend(attention.query(newest), attention.key(h), attention.value(h))
    )


class EgoPoserGraph(StreamingGraph):
    """EgoPoser's streaming graph, which carries the embedding's output for each frame, in order of time.

    At every step the slow view pairs other frames, so nothing after the embedding can be carried. The
    movement since the window's first frame enters linearly, so the first frame's contribution is subtracted
    from the sum.
    """

    float32_modules = ("model.embedding", "model.orientation", "model.rotation")
    model: EgoPoser

    def build(self, model: MotionModel) -> None:
        """Make the graph's parts from a copy of the network."""
        assert isinstance(model, EgoPoser)
        self.model, self.layers = model, cast(list[EncoderLayer], list(model.layers))

    def windows(self) -> State:
        """Return zeros (T - 1, n): each earlier frame's embedding (n = d) and places on the floor (n = 6)."""
        sizes = {"embedded": self.model.embedding.out_features, "places": PLACES}
        return {name: torch.zeros(self.frames - 1, size) for name, size in sizes.items()}

    def step(self, sparse: Tensor, state: State, fresh: Tensor) -> tuple[Tensor, State]:
        """Map world inputs (1, 54) and the state to world motion (1, 198) and the new state."""
        local = beside_head(self.normalizer.encode_sparse(sparse, self.normalizer.origin(sparse)))
        place = places(local)
        entering = {"embedded": self.model.embedding(torch.cat([local, place], -1)), "places": place}
        window = {
            name: torch.cat([filled(state[name], frame, fresh), frame]) for name, frame in entering.items()
        }
        slow, fast = self.model.views(window["embedded"])
        first = F.linear(window["places"][:1], self.model.embedding.weight[:, SPARSE_DIM:])
        newest = newest_frame(self.layers, slow + fast - 2 * first)
        kept = {name: frames[1:] for name, frames in window.items()}
        return self.normalizer.posed(self.model.read(newest), sparse), kept


class AGRoLGraph(StreamingGraph):
    """The base of the streaming graphs of AGRoL's networks; it carries the stem's outputs."""

    float32_modules: tuple[str, ...] = ("model.stem", "model.head")
    width: int

    def windows(self) -> State:
        """Return zeros (T - 1, d): the stem's output for each earlier frame's inputs."""
        return {"stem": torch.zeros(self.frames - 1, self.width)}

    def step(self, sparse: Tensor, state: State, fresh: Tensor) -> tuple[Tensor, State]:
        """Map world inputs (1, 54) and the state to world motion (1, 198) and the new state."""
        entering = self.entering(self.normalizer.encode_sparse(sparse, self.normalizer.origin(sparse)))
        window = torch.cat([filled(state["stem"], entering, fresh), entering])
        return self.normalizer.posed(self.rotation(window), sparse), {"stem": window[1:]}

    def entering(self, encoded: Tensor) -> Tensor:
        """Return the stem's output (1, d) for one frame's inputs (1, 54), as it is carried."""
        raise NotImplementedError

    def rotation(self, window: Tensor) -> Tensor:
        """Map a window of the stem's carried outputs (T, d) to the rotations (1, 132) of its newest frame."""
        raise NotImplementedError


class AGRoLMLPGraph(AGRoLGraph):
    """The streaming graph of AGRoL's MLP."""

    model: AGRoLMLP
    blocks: list[MLPBlock]

    def build(self, model: MotionModel) -> None:
        """Make the graph's parts from a copy of the network."""
        assert isinstance(model, AGRoLMLP)
        self.model, self.width = model, model.stem.out_features
        self.blocks = cast(list[MLPBlock], list(model.blocks))

    def entering(self, encoded: Tensor) -> Tensor:
        """Return the stem's output (1, d) for a frame's inputs (1, 54)."""
        return self.model.stem(encoded)

    def rotation(self, window: Tensor) -> Tensor:
        """Apply the blocks to (T, d), the last block for the newest frame alone, then the head: (1, 132)."""
        *earlier, last = self.blocks
        for block in earlier:
            window = block(window)
        return self.model.head(last.newest(window, 1))


class AGRoLDiffusionGraph(AGRoLGraph):
    """The streaming graph of AGRoL's diffusion model.

    The shift that each block adds for the diffusion time is the same at every step of a stream, so it is
    computed once.
    """

    model: AGRoLDiffusion
    blocks: list[MLPBlock]
    shifts: Tensor

    def build(self, model: MotionModel) -> None:
        """Make the graph's parts from a copy of the network."""
        assert isinstance(model, AGRoLDiffusion)
        self.model, self.width = model, model.stem.out_features
        self.blocks = cast(list[MLPBlock], list(model.blocks))
        embedding = F.silu(model.time(torch.tensor(model.diffusion.times).to(model.noise)))
        timed = cast(list[TimedBlock], self.blocks)
        self.register_buffer("shifts", torch.stack([block.time(embedding) for block in timed], 1))

    def entering(self, encoded: Tensor) -> Tensor:
        """Return the part of the stem's output (1, d) that comes from a frame's inputs (1, 54).

        The part that comes from the noisy motion is added at each denoiser call.
        """
        return F.linear(encoded, self.model.stem.weight[:, ROTATION.stop :], self.model.stem.bias)

    def rotation(self, window: Tensor) -> Tensor:
        """Sample by DDIM; the denoiser's last call computes the newest frame (1, 132) alone."""
        diffusion, noisy = self.model.diffusion, self.model.noise
        for index in range(len(diffusion.times) - 1):
            noisy = diffusion.stepped(noisy, self._denoised(noisy, window, index, self.frames), index)
        return self._denoised(noisy, window, len(diffusion.times) - 1, 1)

    def _denoised(self, noisy: Tensor, window: Tensor, index: int, count: int) -> Tensor:
        """Predict the newest `count` clean rotations at sampling step `index` from noisy ones (T, 132)."""
        h = window + F.linear(noisy, self.model.stem.weight[:, : ROTATION.stop])
        *earlier, last = zip(self.blocks, self.shifts[index], strict=True)
        for block, shift in earlier:
            h = block.newest(h + shift, self.frames)
        block, shift = last
        return self.model.head(block.newest(h + shift, count))


class FrameGraph(StreamingGraph):
    """The streaming graph of a network without a window: the network itself, one frame per step."""

    model: WindowlessModel

    def build(self, model: MotionModel) -> None:
        """Make the graph's parts from a copy of the network."""
        assert isinstance(model, WindowlessModel)
        self.model = model

    def windows(self) -> State:
        """Return the network's state at a fresh start, which is all that it carries: it has no window."""
        return self.model.initial_state(1)

    def step(self, sparse: Tensor, state: State, fresh: Tensor) -> tuple[Tensor, State]:
        """Map world inputs (1, 54) and the state to world motion (1, 198) and the new state."""
        motion, kept = self.model.advance(sparse[None], state, 1)
        return motion[0], kept


class HMDPoserGraph(FrameGraph):
    """HMD-Poser's streaming graph."""

    float32_modules = ("model.trackers", "model.hands", "model.others", "model.pose")
    model: HMDPoser

    def step(self, sparse: Tensor, state: State, fresh: Tensor) -> tuple[Tensor, State]:
        """Map world inputs (1, 54) and the state to world motion (1, 198) and the new state."""
        features, kept = self.model.features(sparse[None], state)
        return self.normalizer.posed(self.model.pose(features[0]), sparse), kept


class VAEHMDGraph(FrameGraph):
    """VAE-HMD's streaming graph."""

    float32_modules = ("model.encoder.stem", "model.decoder.head")
    model: VAEHMD

    def step(self, sparse: Tensor, state: State, fresh: Tensor) -> tuple[Tensor, State]:
        """Map world inputs (1, 54) to world motion (1, 198); nothing is carried on."""
        mean = self.model.latent(sparse).chunk(2, -1)[0]
        return self.normalizer.posed(self.model.decoder(mean), sparse), {}


class StillPoseGraph(FrameGraph):
    """The streaming graph of one pose, in which nothing can be quantised."""

    float32_modules = ()
    model: StillPose


class RPMGraph(FrameGraph):
    """RPM's streaming graph."""

    float32_modules = ("model.motion", "model.sparse", "model.head")
    model: RPM


class AvatarJLMGraph(StreamingGraph):
    """AvatarJLM's streaming graph, which carries the tokens of each frame, in order of time.

    The tokens' position embeddings change at every step and attention looks both ways in time, so all layers
    are computed anew; the last one, over time, is computed for the newest frame alone.
    """

    float32_modules = ("model.embedding", "model.coarse", "model.regressor")
    model: AvatarJLM
    layers: list[EncoderLayer]

    def build(self, model: MotionModel) -> None:
        """Make the graph's parts from a copy of the network."""
        assert isinstance(model, AvatarJLM)
        self.model, self.layers = model, cast(list[EncoderLayer], list(model.layers))

    def windows(self) -> State:
        """Return zeros (T - 1, 45 d): each earlier frame's tokens, without position embeddings."""
        return {"tokens": torch.zeros(self.frames - 1, self.model.joint_places.numel())}

    def step(self, sparse: Tensor, state: State, fresh: Tensor) -> tuple[Tensor, State]:
        """Map world inputs (1, 54) and the state to world motion (1, 198) and the new state."""
        encoded = self.normalizer.encode_sparse(sparse, self.normalizer.origin(sparse))
        entering = self.model.tokens(encoded).flatten(1)
        window = torch.cat([filled(state["tokens"], entering, fresh), entering])
        h = self.model.placed(window.unflatten(-1, (TOKENS, -1)))
        first = h[:, -1:]
        for index, layer in enumerate(self.layers[:-1]):
            turned = h if index % 2 == 0 else h.transpose(0, 1)
            made = attended(layer, turned, turned)
            h = self.model.renewed(made if index % 2 == 0 else made.transpose(0, 1), first)
        by_token = h.transpose(0, 1)
        newest = attended(self.layers[-1], by_token[:, -1:], by_token).transpose(0, 1)
        features = self.model.renewed(newest, first[-1:]).flatten(1)
        return self.normalizer.posed(self.rotation(features, encoded), sparse), {"tokens": window[1:]}

    def rotation(self, features: Tensor, encoded: Tensor) -> Tensor:
        """Map the newest frame's tokens (1, 45 d) and inputs (1, 54) to its rotations (1, 132)."""
        return self.model.regressor(features)


class ManikinLGraph(AvatarJLMGraph):
    """MANIKIN-L's streaming graph: AvatarJLM's graph, then the solver of the newest frame's limbs."""

    model: ManikinL

    def rotation(self, features: Tensor, encoded: Tensor) -> Tensor:
        """Map the newest frame's tokens (1, 45 d) and inputs (1, 54) to its rotations (1, 132)."""
        return self.model.posed(self.model.regressor(features), encoded)


def attended(layer: EncoderLayer, h: Tensor, seen: Tensor) -> Tensor:
    """Apply an encoder layer to (N, n, d), which attends to (N, m, d), written as plain matrix products."""
    attention, flat, all_seen = layer.attention, h.flatten(0, 1), seen.flatten(0, 1)
    query = attention.query(flat).view(h.shape)
    key, value = (part(all_seen).view(seen.shape) for part in (attention.key, attention.value))
    return layer.finish(flat, attention.attend(query, key, value).flatten(0, 1)).view(h.shape)
