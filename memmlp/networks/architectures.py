"""Families of networks: an `Architecture` builds the networks of one family, and loads trained ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from memmlp.motion.network_coordinates import Coordinates
from memmlp.motion.normalizer import Normalizer
from memmlp.motion.preparing.manifest import Manifest
from memmlp.networks import checkpoint
from memmlp.networks.mem_mlp import MemMLP
from memmlp.networks.memory import Memory
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.predictor import Predictor
from memmlp.networks.refiner import Refined, SAGERefinerSettings
from memmlp.networks.vqvae import VQVAE


@dataclass(frozen=True)
class Architecture:
    """How the networks of a family are built, and the VQ-VAE that some of them use; the base of all families.

    Attributes:
        coordinates: the coordinates in which the network sees the world.
        normalize: whether features are normalised to z-scores.
        vqvae: makes a VQ-VAE with fresh weights.
    """

    coordinates: Coordinates
    normalize: bool
    vqvae: Callable[[], VQVAE]

    @property
    def uses_codes(self) -> bool:
        """Whether the network needs a frozen VQ-VAE."""
        return False

    @property
    def trains_codes(self) -> bool:
        """Whether the network has a VQ-VAE of its own that is trained with it."""
        return False

    def build(self, normalizer: Normalizer, codes: VQVAE | None) -> MotionModel:
        """Build the network with fresh weights.

        Args:
            normalizer: converts between the world and network space.
            codes: the frozen VQ-VAE, where the network uses one.
        """
        raise NotImplementedError

    def build_for_training(self, normalizer: Normalizer, upstream: Path | None) -> MotionModel:
        """Build the network as its training begins.

        Args:
            normalizer: converts between the world and network space.
            upstream: file of the weights of the run that this one builds upon; None where there is no such
                run.

        Raises:
            InputError: if the file of weights is damaged.
        """
        return self.build(normalizer, self.load_vqvae(upstream) if upstream else None)

    def normalizer(self, manifest: Manifest, frames: Tensor) -> Normalizer:
        """Make the normalizer, with the statistics of the training frames (F, 252) if `normalize` is set."""
        rest = torch.as_tensor(np.asarray(manifest.rest), dtype=torch.float32)
        if self.normalize:
            return Normalizer.fit(self.coordinates, rest, frames)
        return Normalizer.raw(self.coordinates, rest)

    def load_vqvae(self, weights: Path) -> VQVAE:
        """Load a trained VQ-VAE from a file of weights.

        Raises:
            InputError: if the file is damaged.
        """
        model = self.vqvae()
        checkpoint.load_module("model", model, checkpoint.read(weights)[0])
        return model.eval()

    def load(self, weights: Path) -> MotionModel:
        """Load a trained network from a file of weights.

        Raises:
            InputError: if the file is damaged.
        """
        tensors, _ = checkpoint.read(weights)
        codes = self.vqvae() if self.uses_codes else None
        model = self.build(Normalizer.raw(self.coordinates, torch.zeros(22, 3)), codes)
        checkpoint.load_module("model", model, tensors)
        return model.eval()


@dataclass(frozen=True)
class MemMLPArchitecture(Architecture):
    """How Mem-MLP is built.

    Attributes:
        frames: T, the window's length.
        hidden: d, the width of the hidden state.
        depth: L, the number of the backbone's blocks.
        memory: makes the memory, given `codes`, `depth`, `hidden` and `frames`.
        predictor: makes the predictor, given `memory_block`, `hidden` and `frames`.
        codes: "frozen" if the memory needs a VQ-VAE that is trained before, "joint" if it has one of its own.
    """

    frames: int
    hidden: int
    depth: int
    memory: Callable[..., Memory]
    predictor: Callable[..., Predictor]
    codes: str = ""

    @property
    def uses_codes(self) -> bool:
        """Whether the memory needs a frozen VQ-VAE."""
        return self.codes == "frozen"

    @property
    def trains_codes(self) -> bool:
        """Whether the memory has a VQ-VAE of its own that is trained with the network."""
        return self.codes == "joint"

    def build(self, normalizer: Normalizer, codes: VQVAE | None) -> MemMLP:
        """Build the network with fresh weights."""
        sizes = {"hidden": self.hidden, "frames": self.frames}
        memory = self.memory(codes=codes, depth=self.depth, **sizes)
        predictor = self.predictor(memory_block=memory.memory_block, **sizes)
        return MemMLP(normalizer, memory, predictor, depth=self.depth, **sizes)


@dataclass(frozen=True)
class PlainArchitecture(Architecture):
    """How a network with neither memory nor predictor slot is built, as all baselines are.

    Attributes:
        network: makes the network from its normalizer; all other arguments are bound already.
    """

    network: Callable[[Normalizer], MotionModel]

    def build(self, normalizer: Normalizer, codes: VQVAE | None) -> MotionModel:
        """Build the network with fresh weights; `codes` is not used."""
        return self.network(normalizer)


@dataclass(frozen=True)
class PartedArchitecture(PlainArchitecture):
    """The architecture of a network whose parts are trained one after the other, before the whole network is.

    Attributes:
        finished: names of the parts whose trained weights are loaded and frozen where the training of the
            remaining parts begins; empty where the whole network is trained further.
    """

    finished: tuple[str, ...] = ()

    def build_for_training(self, normalizer: Normalizer, upstream: Path | None) -> MotionModel:
        """Build the network with the weights of its parts; see Architecture."""
        assert upstream is not None
        model, (tensors, _) = self.build(normalizer, None), checkpoint.read(upstream)
        for name in self.finished:
            checkpoint.load_module(f"model.{name}", model.get_submodule(name).requires_grad_(False), tensors)
        if not self.finished:
            checkpoint.load_module("model", model, tensors)
        return model


@dataclass(frozen=True)
class RefinedArchitecture(Architecture):
    """How a network with a refiner behind it is built.

    Attributes:
        network: builds the network itself.
        refiner: makes the refiner around it.
    """

    network: Architecture
    refiner: SAGERefinerSettings

    @property
    def uses_codes(self) -> bool:
        """Whether the network needs a frozen VQ-VAE."""
        return self.network.uses_codes

    @property
    def trains_codes(self) -> bool:
        """Whether the network has a VQ-VAE of its own that was trained with it."""
        return self.network.trains_codes

    def build(self, normalizer: Normalizer, codes: VQVAE | None) -> Refined:
        """Build the network and its refiner with fresh weights."""
        return self.refiner.around(self.network.build(normalizer, codes))
