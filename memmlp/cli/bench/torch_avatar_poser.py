"""An AvatarPoser of torch's own layers, with which `bench latency` checks the time of our network."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from memmlp.deploy.export import silenced
from memmlp.motion.body import N_JOINTS, SPARSE_DIM


class TorchAvatarPoser(nn.Module):
    """The layers of AvatarPoser, none of which are this project's own.

    Args:
        frames: T, the window's length.
        width, depth, heads, feedforward: the sizes of the encoder.
    """

    def __init__(self, frames: int, width: int, depth: int, heads: int, feedforward: int):
        super().__init__()
        self.frames = frames
        self.embedding = nn.Linear(SPARSE_DIM, width)
        layer = nn.TransformerEncoderLayer(width, heads, feedforward, batch_first=True)
        self.encoder = nn.TransformerEncoder(layer, depth)  # copies the layer with its weights
        self.orientation = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 6))
        self.rotation = nn.Sequential(
            nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 6 * (N_JOINTS - 1))
        )

    def forward(self, window: Tensor) -> Tensor:
        """Map a window of features (1, T, 54) to the newest frame's rotations (1, 132)."""
        newest = self.encoder(self.embedding(window))[:, -1]
        return torch.cat([self.orientation(newest), self.rotation(newest)], -1)


def export_plainly(network: TorchAvatarPoser, path: Path) -> None:
    """Write a network with `torch.onnx.export` and nothing else, each layer with its own random weights.

    Layers with equal weights would share them in the file, and would be faster than those of a trained
    network.
    """
    for parameter in network.parameters():
        nn.init.normal_(parameter, std=0.03)
    with silenced():
        window = torch.zeros(1, network.frames, SPARSE_DIM)
        torch.onnx.export(network.eval(), (window,), path, dynamo=True, verbose=False, external_data=False)
