"""Tiny training tasks of every kind, and their optimisers."""

from functools import partial

import tiny
import torch
from torch import nn

from memmlp.networks import checkpoint
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.own_past_memory import JointCodeMemory
from memmlp.networks.sage_parts import LOWER, UPPER
from memmlp.networks.vqvae import VQVAE
from memmlp.runs.run import Run
from memmlp.training.losses import (
    AGRoLLoss,
    AvatarPoserLoss,
    Loss,
    LossOfNetwork,
    MotionLoss,
    PositionHandTerm,
    RPMLoss,
    TermsLoss,
    UncertaintyWeights,
)
from memmlp.training.optim import Optim
from memmlp.training.rollout import OwnPredictions, PersistentStreams, Rollout, TeacherForcing
from memmlp.training.train_network import MotionTask, NetworkTraining, VQVAETask
from memmlp.training.train_sage import PARTS, SAGEPartTask, make_objective

OPTIM = Optim(steps=12, batch=4, lr=1e-3, final_lr=1e-4, schedule="cosine", checkpoint_every=5, log_every=4)
HMD_POSER = {
    "orientation": 1.0, "rotation": 5.0, "global_rotation": 1.0, "world_position": 1.0, "acceleration": 0.5,
}  # fmt: skip
LOSSES = {
    "hmd_poser": partial(TermsLoss, **HMD_POSER),
    "rpm": RPMLoss,
    "avatar_poser": AvatarPoserLoss,
    "agrol_diffusion": AGRoLLoss,
    "bodiffusion": LossOfNetwork,
}
ROLLOUTS = {
    "forced": TeacherForcing,
    "own": lambda: OwnPredictions(2),
    "streams": lambda: PersistentStreams(6),
}


def make_task(model: MotionModel, loss: Loss, rollout: Rollout, optim: Optim, seed: int = 0) -> MotionTask:
    rollout.begin(model)
    return MotionTask(model, loss, rollout, tiny.frames(), optim, seed, validate=lambda _: {"answer": 42.0})


def motion_task(rollout: str = "own", optim: Optim = OPTIM, seed: int = 0, **changes) -> MotionTask:
    model = tiny.model(seed=seed, **changes)
    loss = MotionLoss(UncertaintyWeights(), PositionHandTerm(), model.predictor.branches)
    return make_task(model, loss, ROLLOUTS[rollout](), optim, seed)


def baseline_task(name: str, optim: Optim = OPTIM) -> MotionTask:
    return make_task(tiny.baseline(name, depth=1), LOSSES[name](), TeacherForcing(), optim)


def recurrent_task(rollout: str = "forced", optim: Optim = OPTIM) -> MotionTask:
    loss = TermsLoss(weighting="learned", rotation=1.0, world_position=2.0, velocity=20.0)
    return make_task(tiny.recurrent_poser(members=2), loss, ROLLOUTS[rollout](), optim)


def vqvae_task(optim: Optim = OPTIM) -> VQVAETask:
    torch.manual_seed(0)
    model = VQVAE(codes=8, width=12, encoder_depth=1)
    return VQVAETask(model, tiny.normalizer(), tiny.frames(), tiny.frames((30,), seed=9), optim, seed=0)


def part_task(kind: str, optim: Optim = OPTIM, seed: int = 0) -> SAGEPartTask:
    """The task of training one of SAGE-Net's parts; those before it have random weights."""
    net = tiny.baseline("sage", seed=seed)
    halves = nn.ModuleDict(
        {"net": net, "upper": net.make_codes(UPPER), "lower": net.make_codes(LOWER)}
    ).eval()
    part = {"upper_diffusion": net.upper, "lower_diffusion": net.lower}.get(kind, halves[kind.split("_")[0]])
    network = NetworkTraining(seed, lambda branches: TermsLoss(angle=1), TeacherForcing(), optim, "frames")
    halves.requires_grad_(False)
    objective, validation = make_objective(kind, halves), tiny.frames((30,), seed=9)
    return SAGEPartTask(part.requires_grad_(True), objective, network, tiny.frames(), validation, net.frames)


def weights(run: Run) -> dict[str, torch.Tensor]:
    return checkpoint.read(run.checkpoint)[0]


TASKS = {
    **{name: partial(motion_task, name) for name in ROLLOUTS},
    **{name: partial(baseline_task, name) for name in LOSSES},
    "recurrent forced": recurrent_task,
    "muon": partial(motion_task, "forced"),
    "schedule_free": partial(motion_task, "forced"),
    "vqvae": vqvae_task,
    "joint": partial(motion_task, kind=JointCodeMemory),
    **{kind: partial(part_task, kind) for kind in PARTS if kind != "decoder"},
}
