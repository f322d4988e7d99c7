"""A constant pose for every frame, as a baseline: a network that has learned only the average pose.

A useful network has much lower errors. Such baselines are common in motion prediction, such as the
zero-velocity baseline (Martinez et al., CVPR 2017). Papers on sparse tracking do not report one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from memmlp.common.components import component
from memmlp.common.settings import at_least, setting, tuned
from memmlp.motion.body import N_JOINTS, ROTATION
from memmlp.motion.geometry import matrix_to_sixd
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.motion_model import FrameGraph, State, WindowlessModel
from memmlp.networks.settings import NetworkSettings


class ConstantPoseGraph(FrameGraph):
    """The streaming graph of a constant pose; it does not have layers to quantise."""

    float32_modules = ()
    model: ConstantPose


@component("model", "constant_pose", builds="ConstantPose")
@dataclass
class ConstantPoseSettings(NetworkSettings):
    """A baseline for tables: the average pose, which turns and moves with the head."""

    # T, the number of frames in a training window
    frames: int = setting(at_least(2), tiny=10, small=40, paper=40)

    defaults: ClassVar = {"loss": "avatar_poser"}
    recipe: ClassVar = {"normalizer.coordinates": "heading", "normalizer.z_scores": True, **tuned(8.0e-3)}


class ConstantPose(WindowlessModel):
    """A learned constant pose; the coordinates turn and move it, by default with the head.

    It has 132 parameters, the joints' local rotations. Their initial value is the normalizer's mean, or the
    identity without z-scores (`normalizer.z_scores=false`).
    """

    graph = ConstantPoseGraph

    def __init__(self, normalizer: Normalizer, settings: ConstantPoseSettings):
        super().__init__(normalizer, settings.frames)
        self.pose = nn.Parameter(torch.zeros(ROTATION.stop))
        if not normalizer.mean.any():  # zeros would be no rotations then, and their gradient has no bound
            self.pose.data.copy_(matrix_to_sixd(torch.eye(3)).repeat(N_JOINTS))

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        seen = sparse if newest is None else sparse[:, -newest:]
        return self.normalizer.decode_rotations(self.pose.expand(*seen.shape[:-1], -1), seen), state
