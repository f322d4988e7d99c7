"""Tiny motion and tiny networks that the tests share."""

import math
from typing import Any

import numpy as np
import torch
import yaml

from memmlp.common.components import find_component, list_component_names
from memmlp.motion.body import FRAME_DIM, make_builtin_rest_joints
from memmlp.motion.dataset import MotionDataset
from memmlp.motion.geometry import compute_motion_frames
from memmlp.motion.network_coordinates import Heading, HeadRelative, World
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.mem_mlp import MemMLP
from memmlp.networks.memory import Memory, NoMemory
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.own_past_memory import CodeMemory, CodeMemorySettings, JointCodeMemory
from memmlp.networks.predictor import TwoBranchSettings
from memmlp.networks.recurrent_poser import RecurrentPoser, RecurrentPoserSettings
from memmlp.networks.refiner import RefinedModel
from memmlp.networks.vqvae import VQVAE

SIZES = {"hidden": 16, "frames": 7}
DEPTH = 4
REST = torch.tensor(make_builtin_rest_joints())


def clip(length: int, seed: int = 0, spread: float = 0.3) -> torch.Tensor:
    """Make world frames (length, 252) of smooth random motion of an upright person."""
    rng = np.random.default_rng(seed)
    t = np.arange(length + 1)[:, None, None] / 60
    waves = rng.normal(size=(3, 22, 3)) * spread
    rate, phase = rng.uniform(0.5, 3, (3, 22, 3)), rng.uniform(0, 2 * math.pi, (3, 22, 3))
    poses = sum(waves[i] * np.sin(2 * math.pi * rate[i] * t + phase[i]) for i in range(3))
    poses[:, 0] = np.array([math.pi / 2, 0, 0]) + 0.1 * poses[:, 0]
    trans = np.cumsum(rng.normal(size=(length + 1, 3)) * 0.003, 0) + np.array([0, 0, 0.95])
    return compute_motion_frames(torch.tensor(poses), torch.tensor(trans), REST).float()


def frames(lengths: tuple[int, ...] = (60, 45, 80), seed: int = 0) -> MotionDataset:
    clips = [clip(length, seed + i) for i, length in enumerate(lengths)]
    starts = torch.tensor([0, *np.cumsum(lengths)[:-1]])
    return MotionDataset(
        torch.cat(clips), starts, torch.tensor(lengths), [f"clip{i}" for i in range(len(lengths))]
    )


def normalizer(coordinates: World | None = None) -> Normalizer:
    """Make a normalizer with made-up statistics."""
    draw = torch.Generator().manual_seed(5)
    std = 0.2 + torch.rand(FRAME_DIM, generator=draw)
    return Normalizer(coordinates or HeadRelative(), REST, 0.1 * torch.randn(FRAME_DIM, generator=draw), std)


def vqvae() -> VQVAE:
    torch.manual_seed(3)
    model = VQVAE(codes=8, width=12, encoder_depth=2)
    model.codebook.vectors.normal_()
    return model.eval()


def memory(kind: type[Memory] = CodeMemory, **changes) -> Memory:
    """Make a memory for the tiny network, with changed settings."""
    if kind is NoMemory:
        return NoMemory(depth=DEPTH, **SIZES)
    given: dict[str, Any] = {"layers": (2, 4), "width": 6, "fusion": "residual"}
    given |= {"shift": "window", "history": "first"}
    more: dict[str, Any] = {"depth": DEPTH, **SIZES}
    if kind is CodeMemory:
        more["codes"] = changes.pop("codes", None) or vqvae()
    if kind is JointCodeMemory:
        more["vqvae"] = changes.pop("vqvae", vqvae)
    return kind(CodeMemorySettings(**given | changes), **more)


def model(
    kind: type[Memory] = CodeMemory,
    predictor: type[TwoBranchSettings] = TwoBranchSettings,
    coordinates: World | None = None,
    seed: int = 0,
    **changes,
) -> MemMLP:
    """Make a tiny network with random weights, in evaluation mode."""
    torch.manual_seed(seed)
    slot = memory(kind, **changes)
    torch.manual_seed(seed)
    head = find_component("predictor", predictor.name).build(
        {"depth": 1}, memory_block=slot.make_memory_block, **SIZES
    )
    return MemMLP(normalizer(coordinates), slot, head, depth=DEPTH, **SIZES).eval()


BASELINES: dict[str, dict[str, Any]] = {
    "agrol_mlp": dict(frames=7, width=16, depth=2),
    "agrol_diffusion": dict(
        frames=7, width=16, depth=2, diffusion_steps=50, sampling_steps=3, noise_seed=0, sampler="ddim"
    ),
    "bodiffusion": dict(
        frames=7, width=48, depth=2, heads=3, diffusion_steps=50, sampling_steps=3, noise_seed=0,
        noise_weight=1.0, bound_weight=1.0, offline=False, sampler="ancestral",
    ),
    "avatar_poser": dict(frames=7, width=16, depth=2, heads=4, feedforward=32, dropout=0.1),
    "ego_poser": dict(frames=7, width=16, depth=2, heads=4, feedforward=32, dropout=0.1),
    "hmd_poser": dict(frames=7, width=16, depth=2, encoder_layers=1, heads=4, feedforward=32, dropout=0.1,
        shape_weight=0.1,
    ),
    "vae_hmd": dict(frames=7, width=16, depth=2, latent=6, dropout=0.2, divergence_weight=0.01),
    "avatar_jlm": dict(frames=7, width=16, depth=2, heads=4, feedforward=32, dropout=0.1, coarse_weight=1.0
    ),
    "rpm": dict(frames=9, width=16, depth=2, heads=4, feedforward=32, dropout=0.1, context=3, horizon=4
    ),
    "manikin_s": dict(frames=7, width=16, depth=2, heads=4, feedforward=32, dropout=0.0, parts_weight=1.0,
        root_weight=0.0, turned=True,
    ),
    "manikin_l": dict(frames=7, width=16, depth=2, heads=4, feedforward=32, dropout=0.1, coarse_weight=1.0,
        parts_weight=1.0, turned=True, offline=False,
    ),
    "sage": dict(frames=8, width=16, depth=1, heads=2, code_width=16, code_depth=1, code_heads=2, dropout=0.1,
        diffusion_steps=50, sampling_steps=2, noise=0.01, noise_seed=0,
    ),
}  # fmt: skip


def tiny_sizes(name: str) -> dict[str, Any]:
    """Return the sizes that a network declares for the tiny profile."""
    defaults = vars(find_component("model", name).make_settings({}))
    return {
        key: yaml.safe_load(value.removeprefix("${size:").split(",")[0])
        for key, value in defaults.items()
        if str(value).startswith("${size:")
    }


for new in set(list_component_names("model")) - {*BASELINES, "mem_mlp", "recurrent_poser", "constant_pose"}:
    BASELINES[new] = tiny_sizes(new)


def build_baseline(name: str, normalizer: Normalizer, **changes) -> MotionModel:
    network = find_component("model", name)
    return network.kind(normalizer, network.make_settings(BASELINES[name] | changes))


def baseline(name: str, coordinates: World | None = None, seed: int = 0, **changes) -> MotionModel:
    torch.manual_seed(seed)
    return build_baseline(name, normalizer(coordinates), **changes).eval()


def recurrent_poser(coordinates: World | None = None, seed: int = 0, **changes) -> RecurrentPoser:
    torch.manual_seed(seed)
    settings = {
        "frames": 7, "width": 16, "depth": 2, "cell": "gru", "expansion": 2, "output": "local", "members": 1,
    }  # fmt: skip
    return RecurrentPoser(normalizer(coordinates), RecurrentPoserSettings(**settings | changes)).eval()


def refined(network: MotionModel | None = None) -> RefinedModel:
    """Make a network with a tiny refiner of random weights behind it, in evaluation mode."""
    network = network or model(coordinates=Heading())
    torch.manual_seed(1)
    return RefinedModel(network, width=6, depth=2).eval()
