"""The baselines' streaming graphs.

AvatarPoser reads one frame of its last layer, and of AGRoL's output one frame is kept: so the last layer
computes that frame alone. The first layer's products that depend on one frame alone are carried.
"""

from __future__ import annotations

from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor

from memmlp.motion.body import ROTATION
from memmlp.networks.baselines.agrol import AGRoLDiffusion, AGRoLMLP, TimedBlock
from memmlp.networks.baselines.avatar_poser import AvatarPoser, EncoderLayer
from memmlp.networks.layers import MLPBlock
from memmlp.networks.memory import State
from memmlp.networks.streaming.ring import Ring, StreamingGraph
from memmlp.networks.window_model import WindowModel


class AvatarPoserStream(StreamingGraph):
    """AvatarPoser's streaming graph; its encoder ignores the order of frames, so a ring's order will do."""

    ends = ("model.embedding", "model.orientation", "model.rotation")
    model: AvatarPoser
    layers: list[EncoderLayer]

    def build(self, model: WindowModel) -> None:
        """Make the graph's parts from a copy of the network."""
        assert isinstance(model, AvatarPoser)
        self.model, self.layers = model, cast(list[EncoderLayer], list(model.layers))

    def windows(self) -> State:
        """Return zeros (T, 4 d): each frame's embedding and first query, key and value, side by side."""
        return {"first": torch.zeros(self.frames, 4 * self.model.embedding.out_features)}

    def step(self, sparse: Tensor, state: State, ring: Ring) -> tuple[Tensor, State]:
        """Map world inputs (1, 54) and the state to world motion (1, 198) and what is carried on."""
        embedded = self.model.embedding(self.normalizer.encode_sparse(sparse, self.normalizer.origin(sparse)))
        *earlier, last = self.layers
        attention = self.layers[0].attention
        entering = torch.cat(
            [embedded, attention.query(embedded), attention.key(embedded), attention.value(embedded)], -1
        )
        first = ring.put(state["first"], entering, entering)
        h, query, key, value = first.chunk(4, -1)
        for layer, following in zip(earlier, self.layers[1:], strict=True):
            h = layer.finish(h, layer.attention.attend(query[None], key[None], value[None])[0])
            attention = following.attention
            query, key, value = attention.query(h), attention.key(h), attention.value(h)
        attended = last.attention.attend(ring.newest(query)[None], key[None], value[None])[0]
        newest = last.finish(ring.newest(h), attended)
        return self.normalizer.posed(self.model.read(newest), sparse), {"first": first}


class AGRoLStream(StreamingGraph):
    """The base of the streaming graphs of AGRoL's networks; it carries the stem's outputs in order of time.

    A ring would spare one copy of them, but turning the T x T matrices of 12 blocks to its order costs more.
    """

    ends = ("model.stem", "model.head")
    width: int
    blocks: list[MLPBlock]

    def windows(self) -> State:
        """Return zeros (T - 1, d): the stem's share of each earlier frame's inputs."""
        return {"stem": torch.zeros(self.frames - 1, self.width)}

    def step(self, sparse: Tensor, state: State, ring: Ring) -> tuple[Tensor, State]:
        """Map world inputs (1, 54) and the state to world motion (1, 198) and what is carried on."""
        entering = self.entering(self.normalizer.encode_sparse(sparse, self.normalizer.origin(sparse)))
        window = torch.cat([torch.where(state["count"] > 0, state["stem"], entering), entering])
        return self.normalizer.posed(self.rotation(window), sparse), {"stem": window[1:]}

    def entering(self, encoded: Tensor) -> Tensor:
        """Return the stem's share (1, d) of a frame's inputs (1, 54)."""
        raise NotImplementedError

    def rotation(self, window: Tensor) -> Tensor:
        """Map a window of such shares (T, d) to the rotations (1, 132) of its newest frame."""
        raise NotImplementedError


class AGRoLMLPStream(AGRoLStream):
    """The streaming graph of AGRoL's MLP."""

    model: AGRoLMLP

    def build(self, model: WindowModel) -> None:
        """Make the graph's parts from a copy of the network."""
        assert isinstance(model, AGRoLMLP)
        self.model, self.width = model, model.stem.out_features
        self.blocks = cast(list[MLPBlock], list(model.blocks))

    def entering(self, encoded: Tensor) -> Tensor:
        """Return the stem's output (1, d) for a frame's inputs (1, 54)."""
        return self.model.stem(encoded)

    def rotation(self, window: Tensor) -> Tensor:
        """Apply the blocks to (T, d), the last one for the newest frame alone, and the head: (1, 132)."""
        *earlier, last = self.blocks
        for block in earlier:
            window = block(window)
        return self.model.head(last.newest(window, 1))


class AGRoLDiffusionStream(AGRoLStream):
    """The streaming graph of AGRoL's diffusion model.

    The shift that each block adds for the diffusion time is the same at every step of a stream, so it is
    computed once.
    """

    model: AGRoLDiffusion
    shifts: Tensor

    def build(self, model: WindowModel) -> None:
        """Make the graph's parts from a copy of the network."""
        assert isinstance(model, AGRoLDiffusion)
        self.model, self.width = model, model.stem.out_features
        self.blocks = cast(list[MLPBlock], list(model.blocks))
        embedding = F.silu(model.time(torch.tensor(model.diffusion.times).to(model.noise)))
        timed = cast(list[TimedBlock], self.blocks)
        self.register_buffer("shifts", torch.stack([block.time(embedding) for block in timed], 1))

    def entering(self, encoded: Tensor) -> Tensor:
        """Return the stem's output (1, d) for a frame's inputs (1, 54), less the noisy motion's share."""
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
