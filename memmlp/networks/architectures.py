"""Build a config's network, prepare it for training, and load its trained weights."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.network_coordinates import Coordinates
from memmlp.motion.normalizer import Normalizer
from memmlp.motion.preparing.manifest import Manifest
from memmlp.networks import checkpoint
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.refiner import SAGERefinerSettings
from memmlp.networks.vqvae import VQVAE


@dataclass(frozen=True)
class Architecture:
    """The parts of a network: its factory, and optionally a VQ-VAE and a refiner.

    Attributes:
        coordinates: the coordinate system of the network's inputs and outputs.
        normalize: whether features are normalised to z-scores.
        raw_inputs: whether inputs are excluded from the normalisation.
        vqvae: makes a VQ-VAE with random weights.
        network: makes the network with random weights, given its normalizer and the frozen VQ-VAE or None.
        uses_codes: whether the network needs a frozen VQ-VAE.
        trained_parts: names of the parts from a prerequisite run that stay frozen. If empty, all parts are
            trained further. None for a network without such a prerequisite run.
        refiner: the settings of the refiner behind the network; None without a refiner.
    """

    coordinates: Coordinates
    normalize: bool
    vqvae: Callable[[], VQVAE]
    network: Callable[[Normalizer, VQVAE | None], MotionModel]
    uses_codes: bool = False
    trained_parts: tuple[str, ...] | None = None
    refiner: SAGERefinerSettings | None = None
    raw_inputs: bool = False

    def build(self, normalizer: Normalizer, codes: VQVAE | None) -> MotionModel:
        """Build the network with random weights.

        Args:
            normalizer: converts between the world and network space.
            codes: the frozen VQ-VAE; None if the network does not use one.
        """
        model = self.network(normalizer, codes)
        return self.refiner.build(model) if self.refiner else model

    def build_for_training(self, normalizer: Normalizer, prerequisite: Path | None) -> MotionModel:
        """Build the network for the start of its training, without its refiner.

        Args:
            normalizer: converts between the world and network space.
            prerequisite: weights file of the prerequisite run; None without a prerequisite run.

        Raises:
            InputError: if the weights file is damaged.
        """
        tensors = checkpoint.read(prerequisite)[0] if prerequisite else {}
        if self.trained_parts is None:
            if prerequisite is None:
                return self.network(normalizer, None)
            codes = self.vqvae()
            checkpoint.load_module("model", codes, tensors)
            return self.network(normalizer, codes.eval())
        model = self.network(normalizer, None)
        for name in self.trained_parts:
            checkpoint.load_module(f"model.{name}", model.get_submodule(name).requires_grad_(False), tensors)
        if not self.trained_parts:
            checkpoint.load_module("model", model, tensors)
        return model

    def make_normalizer(self, manifest: Manifest, frames: Tensor) -> Normalizer:
        """Make the normalizer; with `normalize`, it uses the statistics of the training frames (F, 252)."""
        rest = torch.as_tensor(np.asarray(manifest.rest), dtype=torch.float32)
        if self.normalize:
            normalizer = Normalizer.fit(self.coordinates, rest, frames)
            if self.raw_inputs:
                normalizer.mean[:SPARSE_DIM], normalizer.std[:SPARSE_DIM] = 0, 1
            return normalizer
        return Normalizer.from_coordinates(self.coordinates, rest)

    def load(self, weights: Path) -> MotionModel:
        """Load a trained network from a weights file.

        Raises:
            InputError: if the file is damaged.
        """
        tensors, values = checkpoint.read(weights)
        codes = self.vqvae() if self.uses_codes else None
        model = self.build(Normalizer.from_coordinates(self.coordinates, torch.zeros(22, 3)), codes)
        checkpoint.load_module("model", model, tensors)
        model.origin = values.get("origin", "")
        return model.eval()
