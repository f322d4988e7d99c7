"""What builds a family's network from its config's parts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from memmlp.motion.coordinates import World
from memmlp.motion.normalizer import Normalizer
from memmlp.motion.prepare import Manifest
from memmlp.networks import checkpoint
from memmlp.networks.mem_mlp import MemMLP
from memmlp.networks.memory import Memory
from memmlp.networks.predictor import Predictor
from memmlp.networks.vqvae import VQVAE
from memmlp.networks.window_model import WindowModel

VQVAE_SETTINGS = ("codes", "width", "encoder_depth", "decoder_depth", "commitment", "decay", "codebook")


@dataclass(frozen=True)
class Architecture:
    """What builds a family's network: this, and `build`.

    Attributes:
        coordinates, normalize: of world <-> network space.
        vqvae: makes a VQ-VAE.
    """

    coordinates: World
    normalize: bool
    vqvae: Callable[[], VQVAE]

    @property
    def uses_codes(self) -> bool:
        """Whether the network wants a frozen VQ-VAE."""
        return False

    @property
    def trains_codes(self) -> bool:
        """Whether the network has a VQ-VAE of its own, trained with it."""
        return False

    def build(self, normalizer: Normalizer, codes: VQVAE | None) -> WindowModel:
        """The network with fresh weights."""
        raise NotImplementedError

    def normalizer(self, manifest: Manifest, frames: Tensor) -> Normalizer:
        """World <-> network space, with the statistics of the training frames (F, 252) where asked."""
        rest = torch.as_tensor(np.asarray(manifest.rest), dtype=torch.float32)
        if self.normalize:
            return Normalizer.fit(self.coordinates, rest, frames)
        return Normalizer.raw(self.coordinates, rest)

    def load_vqvae(self, weights: Path) -> VQVAE:
        """The trained VQ-VAE of a file of weights."""
        model = self.vqvae()
        checkpoint.load_module("model", model, checkpoint.read(weights)[0])
        return model.eval()

    def load(self, weights: Path) -> WindowModel:
        """The trained network of a file of weights. Raises InputError where it is damaged."""
        tensors, _ = checkpoint.read(weights)
        codes = self.vqvae() if self.uses_codes else None
        model = self.build(Normalizer.raw(self.coordinates, torch.zeros(22, 3)), codes)
        checkpoint.load_module("model", model, tensors)
        return model.eval()


@dataclass(frozen=True)
class MemMLPArchitecture(Architecture):
    """Mem-MLP: partial constructors for the slots, and its sizes."""

    frames: int
    hidden: int
    depth: int
    memory: Callable[..., Memory]
    memory_kind: type[Memory]
    predictor: Callable[..., Predictor]

    @property
    def uses_codes(self) -> bool:
        """Whether the memory wants a frozen VQ-VAE."""
        return self.memory_kind.uses_codes

    @property
    def trains_codes(self) -> bool:
        """Whether the memory has a VQ-VAE of its own."""
        return self.memory_kind.trains_codes

    def build(self, normalizer: Normalizer, codes: VQVAE | None) -> MemMLP:
        """The network with fresh weights."""
        sizes = {"hidden": self.hidden, "frames": self.frames}
        memory = self.memory(codes=codes, depth=self.depth, **sizes)
        predictor = self.predictor(memory_block=memory.memory_block, **sizes)
        return MemMLP(normalizer, memory, predictor, depth=self.depth, **sizes)


@dataclass(frozen=True)
class BaselineArchitecture(Architecture):
    """A network without slots: its constructor, all but world <-> network space given."""

    network: Callable[[Normalizer], WindowModel]

    def build(self, normalizer: Normalizer, codes: VQVAE | None) -> WindowModel:
        """The network with fresh weights."""
        return self.network(normalizer)
