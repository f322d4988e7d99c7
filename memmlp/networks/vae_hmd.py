"""VAE-HMD (Dittadi et al., ICCV 2021): a variational autoencoder of poses, and an encoder from the trackers.

Its authors did not publish code; sizes follow the only public re-implementation. The paper first trains the
autoencoder, then the tracker encoder with the frozen decoder. Here both are trained at the same time. About
half of a batch's windows are encoded from true poses and train the autoencoder. The remaining windows are
encoded from the trackers and train only the tracker encoder.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.func import functional_call

from memmlp.common import distributed
from memmlp.common.components import component
from memmlp.common.settings import at_least, fraction, setting, tuned
from memmlp.motion.body import MOTION_DIM, ROTATION, SPARSE_DIM, SPARSE_POSITION, SPARSE_ROTATION
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.layers import Dropout
from memmlp.networks.motion_model import FrameGraph, State, TrainingOutputs, WindowlessModel
from memmlp.networks.settings import NetworkSettings

POSES = (SPARSE_ROTATION, SPARSE_POSITION)
TRACKERS = sum(part.stop - part.start for part in POSES)  # no velocities


class Residual(nn.Module):
    """A residual block of two linear layers, each after a LeakyReLU, with a learned gain, initially 0.

    Args:
        width: d, the width of inputs and outputs.
        dropout: dropout rate between the layers, while training.
    """

    def __init__(self, width: int, dropout: float):
        super().__init__()
        self.share = nn.Parameter(torch.zeros(()))
        self.path = nn.Sequential(
            nn.LeakyReLU(),
            nn.Linear(width, width),
            Dropout(dropout),
            nn.LeakyReLU(),
            nn.Linear(width, width),
        )

    def forward(self, h: Tensor) -> Tensor:
        """Map (..., d) to (..., d)."""
        return h + self.share * self.path(h)


class Perceptron(nn.Module):
    """A linear layer, residual blocks, and a linear output layer.

    Args:
        inputs: number of inputs.
        outputs: number of outputs.
        width: d, the width of the blocks.
        depth: number of blocks.
        dropout: dropout rate of the blocks, while training.
    """

    def __init__(self, inputs: int, outputs: int, width: int, depth: int, dropout: float):
        super().__init__()
        self.stem = nn.Linear(inputs, width)
        self.blocks = nn.Sequential(*(Residual(width, dropout) for _ in range(depth)))
        self.head = nn.Linear(width, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """Map (..., inputs) to (..., outputs)."""
        return self.head(self.blocks(self.stem(x)))


def compute_divergence(latent: Tensor) -> Tensor:
    """Return the KL divergence of latents (means and log variances, (..., 2 z)) from the standard normal.

    The divergence is summed over the z components and averaged over all other axes.
    """
    mean, log_variance = latent.chunk(2, -1)
    return 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(-1).mean()


def draw_latent(latent: Tensor) -> Tensor:
    """Draw samples (..., z) from latents (..., 2 z), given as means and log variances."""
    mean, log_variance = latent.chunk(2, -1)
    return mean + (0.5 * log_variance).exp() * distributed.draw_rows(torch.randn_like, mean)


class VAEHMDGraph(FrameGraph):
    """VAE-HMD's streaming graph."""

    float32_modules = ("model.encoder.stem", "model.decoder.head")
    model: VAEHMD

    def step(self, sparse: Tensor, state: State, is_first_step: Tensor) -> tuple[Tensor, State]:
        """Map world inputs (1, 54) to world motion (1, 198); no state is carried."""
        mean = self.model.encode(sparse).chunk(2, -1)[0]
        return self.normalizer.decode_rotations(self.model.decoder(mean), sparse), {}


@component("model", "vae_hmd", builds="VAEHMD")
@dataclass
class VAEHMDSettings(NetworkSettings):
    """VAE-HMD (Dittadi et al. 2021): maps a frame's trackers to the latent of a pose autoencoder.

    The authors' code is not public; sizes follow a re-implementation. Its two stages are trained at the same
    time (our reading).
    """

    # T, the number of frames in a training window, each a pose of its own; live there is no window
    frames: int = setting(at_least(2), tiny=10, small=40, paper=40)
    width: int = setting(at_least(1), tiny=16, small=128, paper=256)  # d, the width of the hidden layers
    depth: int = setting(at_least(1), 3)  # number of residual blocks in each encoder and in the decoder
    latent: int = setting(at_least(1), 30)  # number of components of the latent
    dropout: float = setting(fraction(), 0.2)  # dropout in the blocks during training
    # weight of the KL divergence. 1 suits the authors' loss, which is in the hundreds. With loss=kinematic,
    # 0.01 is best and 1 makes the latents collapse
    divergence_weight: float = setting(at_least(0), 1.0)

    defaults: ClassVar = {"loss": "vae_hmd"}
    recipe: ClassVar = tuned(8.0e-3)
    kinematic: ClassVar[str] = f"{NetworkSettings.kinematic} model.divergence_weight=0.01"


class VAEHMD(WindowlessModel):
    """VAE-HMD: encodes a frame's trackers as a latent, and decodes the latent's mean to rotations.

    It has 853,958 parameters at the sizes of its re-implementation. The pose encoder, which only training
    uses, is not counted.
    """

    graph = VAEHMDGraph

    def __init__(self, normalizer: Normalizer, settings: VAEHMDSettings):
        super().__init__(normalizer, settings.frames)
        self.divergence_weight = settings.divergence_weight
        sizes = settings.width, settings.depth, settings.dropout
        self.encoder = Perceptron(TRACKERS, 2 * settings.latent, *sizes)
        self.decoder = Perceptron(settings.latent, ROTATION.stop, *sizes)
        self.pose_encoder = Perceptron(MOTION_DIM, 2 * settings.latent, *sizes)

    def count_parameters(self) -> int:
        """Count the trainable parameters without the pose encoder, which only training uses."""
        return super().count_parameters() - sum(p.numel() for p in self.pose_encoder.parameters())

    def encode(self, sparse: Tensor) -> Tensor:
        """Map world inputs (..., 54) to latents (..., 2 z)."""
        encoded = self.normalizer.encode_sparse(sparse, self.normalizer.find_origin(sparse))
        return self.encoder(torch.cat([encoded[..., part] for part in POSES], -1))

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        seen = sparse if newest is None else sparse[:, -newest:]
        return self.normalizer.decode_rotations(self.decoder(self.encode(seen).chunk(2, -1)[0]), seen), state

    def compute_training_outputs(self, sparse: Tensor, state: State, true_frames: Tensor) -> TrainingOutputs:
        """Decode each window either from its true poses or from its trackers; see MotionModel.

        The additional loss is the latents' KL divergence.
        """
        posed = (distributed.draw_rows(torch.rand_like, sparse[:, :1, :1]) < 0.5).to(sparse.dtype)
        of_pose = self.pose_encoder(self.normalizer.encode(true_frames)[..., SPARSE_DIM:])
        latent = posed * of_pose + (1 - posed) * self.encode(sparse)
        sample = draw_latent(latent)
        frozen = {name: weight.detach() for name, weight in self.decoder.named_parameters()}
        live, still = self.decoder(sample), functional_call(self.decoder, frozen, (sample,))
        motion = self.normalizer.decode_rotations(posed * live + (1 - posed) * still, sparse)
        return TrainingOutputs(
            motion, state, {"divergence": self.divergence_weight * compute_divergence(latent)}
        )
