"""The training of SAGE-Net's parts, one after the other, before the whole network (Feng et al., CVPR 2024).

The parts are a VQ-VAE for each half of the body, a diffusion model for the latents of each half, and a
decoder. The lower diffusion model also sees the upper latents that the upper model predicts. The decoder sees
the predictions of both models. Each part has its own run, and its file holds all parts trained so far.
Trained parts stay frozen."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.common import distributed
from memmlp.common.components import component
from memmlp.common.settings import Settings, at_least, each, fraction, group, positive, setting, sized
from memmlp.motion.body import HANDS, HEAD, N_JOINTS, ROOT, ROTATION, SPARSE_DIM, SPARSE_POSITION
from memmlp.motion.dataset import MirroredDataset, MotionDataset, WindowSampler
from memmlp.motion.normalizer import use_float32
from memmlp.networks import checkpoint
from memmlp.networks.sage_net import SAGENet
from memmlp.networks.sage_parts import HIDDEN, LOWER, UPPER, HalfVQVAE
from memmlp.training.loop import StepResult, TrainingTask, train
from memmlp.training.losses.terms import BodyMotion
from memmlp.training.optim import Optim
from memmlp.training.train_network import NetworkTraining, Training, TrainingJob, read_kept_errors

PARTS = ("upper_codes", "lower_codes", "upper_diffusion", "lower_diffusion", "decoder")
"""SAGE-Net's parts in training order; each part uses the parts before it."""

VALIDATION_WINDOWS = 256
HIDDEN_FRACTION = 0.5  # of a half's joints, which its VQ-VAE has to guess
HIDDEN_COUNT = 2  # joints of the diffusion models' condition, drawn with replacement
CODE_WEIGHTS = {"orientation": 0.2, "rotation": 1.0, "position": 5.0, "hand": 5.0, "codebook": 0.25}


@dataclass(frozen=True)
class DroppingOptim(Optim):
    """AdamW whose learning rate is multiplied by `lr_drop` at these fractions of the steps
    (`lr_drops_at`)."""

    lr_drops_at: Sequence[float] = ()
    lr_drop: float = 1.0

    def compute_factor(self, step: int) -> float:
        return self.lr_drop ** sum(step >= at * self.steps for at in self.lr_drops_at)


@dataclass
class SAGEPartSettings:
    """The training of one of SAGE-Net's parts, by AdamW with a weight decay of 1e-4."""

    steps: int = setting(at_least(1), sized(20, 2000, 188000))
    # training compute in TFLOP, with the parts before it; it sets the number of steps. null: `steps` does
    tflop: float | None = setting(positive(), None)
    batch: int = setting(at_least(1), sized(8, 32, 512))  # number of windows per step
    lr: float = setting(positive(), sized(1.0e-3, 1.0e-3, 1.0e-4))
    # when the learning rate drops, as fractions of the steps
    lr_drops_at: list[float] = setting(each(fraction(), empty=True), [0.75])
    lr_drop: float = setting(positive(), 0.25)  # factor of the learning rate at each drop


@component("prerequisite", "sage", version=4)
@dataclass
class SAGEPrerequisiteSettings(Settings):
    """The training of SAGE-Net's parts in separate runs, before the whole network (Feng et al. 2024).

    Learning rates and their drops are the authors' values. At profile=paper the steps draw as many windows as
    the authors' epochs. Only precision and the intervals of optim apply to the parts. Its optimiser, warmup,
    ema, clip_norm, weight_decay and compile apply only to the whole network.
    """

    upper_codes: SAGEPartSettings = group(SAGEPartSettings)  # the VQ-VAE of the upper half of the body
    lower_codes: SAGEPartSettings = group(SAGEPartSettings)  # the VQ-VAE of the lower half
    # the diffusion model of the upper half's latents
    upper_diffusion: SAGEPartSettings = group(
        SAGEPartSettings,
        steps=sized(20, 2000, 240000),
        lr=sized(1.0e-3, 1.0e-3, 2.0e-4),
        lr_drops_at=[0.392, 0.588],
    )
    # the diffusion model of the lower half's latents, given the upper ones that the first predicts
    lower_diffusion: SAGEPartSettings = group(
        SAGEPartSettings,
        steps=sized(20, 2000, 193000),
        lr=sized(1.0e-3, 1.0e-3, 2.0e-4),
        lr_drops_at=[0.366, 0.488],
        lr_drop=0.2,
    )
    # the decoder of what both predict
    decoder: SAGEPartSettings = group(
        SAGEPartSettings, steps=sized(20, 1000, 56000), batch="${profile.batch}", lr_drops_at=[], lr_drop=1.0
    )

    _sizes = ("name", "frames", "code_width", "code_depth", "code_heads", "dropout")
    _denoiser = (*_sizes, "width", "depth", "heads", "diffusion_steps")
    _all = (*_denoiser, "sampling_steps", "noise", "noise_seed")
    model_keys: ClassVar = {
        "upper_codes": _sizes,
        "lower_codes": _sizes,
        "upper_diffusion": _denoiser,
        "lower_diffusion": _all,  # it sees what the upper one samples
        "decoder": _all,
    }
    """The model keys that affect the training of each part."""

    @classmethod
    def prerequisites(cls, config: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield each part with the config keys that affect its result, in training order."""
        for kind in PARTS:
            own: dict[str, Any] = {key: config[key] for key in ("profile", "data", "normalizer", "seed")}
            if kind == "decoder":
                own["loss"] = config["loss"]
            own["model"] = {key: config["model"][key] for key in cls.model_keys[kind]}
            own["prerequisite"] = {key: config["prerequisite"][key] for key in ("name", kind)}
            own["optim"] = {"precision": config["optim"]["precision"]}
            yield kind, own

    def trainings(self, config: Mapping[str, Any], network: NetworkTraining) -> Iterator[SAGEPartTraining]:
        """Yield the training of each part, in order. The parts use the same window sampling as the whole
        `network`."""
        same = ("checkpoint_every", "log_every", "precision")
        often = {name: getattr(network.optim, name) for name in same}
        for kind in PARTS:
            keys = getattr(self, kind)
            betas = (0.9, 0.99) if kind in ("upper_codes", "lower_codes") else (0.9, 0.999)
            optim = DroppingOptim(**keys, **often, betas=betas, validate_every=keys["steps"])
            make = SAGEDecoderTraining if kind == "decoder" else SAGEPartTraining
            yield make(kind, replace(network, optim=optim))


@dataclass(frozen=True)
class SAGEPartTraining(Training):
    """The training of the part `kind`, one of PARTS, in its own run."""

    kind: str
    network: NetworkTraining

    @property
    def description(self) -> str:
        return f"{self.kind.replace('_', ' ')}: training for {self.network.optim.steps} steps"

    def train(self, job: TrainingJob) -> dict[str, float]:
        run, data, device = job.run, job.data, job.device
        before = checkpoint.read(job.prerequisite)[0] if job.prerequisite else {}
        dataset = data.open("train").to(device)
        torch.manual_seed(self.network.seed)
        net = job.architecture.build(job.architecture.make_normalizer(data.manifest, dataset.frames), None)
        assert isinstance(net, SAGENet)
        parts: dict[str, nn.Module] = {
            "codes.upper": net.make_codes(UPPER),
            "codes.lower": net.make_codes(LOWER),
        }
        parts |= {"model.upper": net.upper, "model.lower": net.lower}
        *earlier, (name, part) = islice(parts.items(), PARTS.index(self.kind) + 1)
        for finished, module in earlier:
            checkpoint.load_module(finished, module, before)
        halves = nn.ModuleDict({"net": net, "upper": parts["codes.upper"], "lower": parts["codes.lower"]})
        halves.eval().requires_grad_(False).to(device)
        objective = make_objective(self.kind, halves)
        validation = data.open("val").to(device) if data.has("val") else None
        task = SAGEPartTask(
            part.requires_grad_(True), objective, self.network, dataset, validation, net.frames
        )
        label = self.kind.replace("_", " ")
        train(task, self.network.optim, run, self.network.seed, label, job.on_validation)
        if distributed.is_first():
            checkpoint.write(run.model, before | checkpoint.collect_module_tensors(name, part), {})
        return read_kept_errors(run)


@dataclass(frozen=True)
class SAGEDecoderTraining(SAGEPartTraining):
    """The training of SAGE-Net's decoder on predictions of the trained diffusion models."""

    def train(self, job: TrainingJob) -> dict[str, float]:
        fixed = replace(job.architecture, trained_parts=("upper", "lower"))
        return self.network.train(replace(job, architecture=fixed))


class SAGEPartTask(TrainingTask):
    """The training task of one of SAGE-Net's parts, which minimises an objective on windows of T frames."""

    def __init__(
        self,
        part: nn.Module,
        objective: Objective,
        network: NetworkTraining,
        dataset: MotionDataset,
        validation: MotionDataset | None,
        frames: int,
    ):
        self.module, self.objective, self.frames = part, objective, frames
        self.dataset = MirroredDataset(dataset) if network.mirror else dataset
        draws = network.optim.batch, frames, network.seed, network.drawn_by, network.shares
        self.sampler = WindowSampler(self.dataset, *draws)
        self.validation = None
        if validation is not None:
            drawn = WindowSampler(validation, VALIDATION_WINDOWS, frames, seed=0).draw(0)
            self.validation = validation.read_stretches(*drawn, frames)

    def step(self, step: int) -> StepResult:
        clips, end = map(distributed.take_local_rows, self.sampler.draw(step))
        terms = self.objective(self.dataset.read_stretches(clips, end, self.frames), True)
        return StepResult(torch.stack(list(terms.values())).sum(), terms, clips)

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Compute the losses on the validation windows, with all joints visible and with sampled latents;
        empty without validation windows."""
        if self.validation is None:
            return {}
        return {name: float(term) for name, term in self.objective(self.validation, False).items()}


Objective = Callable[[Tensor, bool], dict[str, Tensor]]
"""Maps world windows (B, T, 252) and a training flag to weighted losses by name."""


def make_objective(kind: str, halves: nn.ModuleDict) -> Objective:
    """Return the objective that trains a part except "decoder"; `halves` has the network ("net"), and the
    VQ-VAE of each half ("upper", "lower")."""
    half, part = kind.split("_")
    net, codes = halves["net"], halves[half]
    assert isinstance(net, SAGENet)
    assert isinstance(codes, HalfVQVAE)
    if part == "codes":
        return partial(compute_code_losses, net, codes)
    return partial(compute_latent_losses, net, codes, lower=half == "lower")


def compute_code_losses(net: SAGENet, codes: HalfVQVAE, frames: Tensor, training: bool) -> dict[str, Tensor]:
    """Return a VQ-VAE's losses for world windows (B, T, 252): rotations and joint positions of the last frame
    in network space, and the codebooks' loss. In training, random joints of the half are hidden, except the
    first joint, so that the VQ-VAE learns to guess them. The upper half also has a loss for the hands'
    positions."""
    rotation, encoded = encode_windows(net, frames)
    sixd = rotation.unflatten(-1, (N_JOINTS, 6))
    hidden = distributed.draw_rows(torch.rand_like, sixd[:, 0, :, 0]) < HIDDEN_FRACTION
    hidden[:, codes.joints[0]] = False
    shown = sixd.masked_fill(hidden[:, None, :, None], HIDDEN) if training else sixd
    latent, codebook = codes.encode(shown.flatten(-2), encoded)
    decoded = codes.decode(latent)[:, -1].unflatten(-1, (-1, 6))
    errors = measure_half_errors(net, codes.joints, decoded, frames[:, -1], sixd[:, -1])
    return {name: CODE_WEIGHTS[name] * term for name, term in (errors | {"codebook": codebook}).items()}


def measure_half_errors(
    net: SAGENet, joints: tuple[int, ...], predicted: Tensor, frame: Tensor, truth: Tensor
) -> dict[str, Tensor]:
    """Return smooth L1 errors of a half's predicted rotations (B, J, 6), network space, and of its joint
    positions by forward kinematics, for world frames (B, 252) and the true rotations (B, 22, 6). A half
    contains all ancestors of its joints, so the other joints' rotations do not matter."""
    sparse, own = frame[:, None, :SPARSE_DIM], list(joints)
    full = truth.clone()
    full[:, own] = predicted.to(truth)
    motions = [net.normalizer.decode_rotations(sixd.flatten(-2)[:, None], sparse) for sixd in (full, truth)]
    bodies = [BodyMotion(motion, net.normalizer) for motion in motions]
    with use_float32(frame.device):
        (found, placed), (expected, true_placed) = [(one.sixd, one.global_pose[1]) for one in bodies]
    errors = {
        "orientation": F.smooth_l1_loss(found[..., ROOT, :], expected[..., ROOT, :]),
        "rotation": F.smooth_l1_loss(found[..., own[1:], :], expected[..., own[1:], :]),
        "position": F.smooth_l1_loss(placed[..., own, :], true_placed[..., own, :]),
    }
    if set(HANDS) <= set(joints):
        head, *hands = sparse[..., SPARSE_POSITION].unflatten(-1, (-1, 3)).unbind(-2)
        moved = placed + (head - placed[..., HEAD, :])[..., None, :]
        errors["hand"] = F.smooth_l1_loss(moved[..., list(HANDS), :], torch.stack(hands, -2))
    return errors


def compute_latent_losses(
    net: SAGENet, codes: HalfVQVAE, frames: Tensor, training: bool, lower: bool
) -> dict[str, Tensor]:
    """Return the smooth L1 error of a half's latents (see `compute_code_losses`). The `lower` half also sees
    sampled latents of the upper half."""
    rotation, encoded = encode_windows(net, frames)
    clean = encode_latents(codes, rotation, encoded)
    with torch.no_grad():
        upper = net.sample_upper(encoded) if lower or not training else clean
    if not training:
        sampled = net.sample_lower(upper, encoded) if lower else upper
        return {"latent": F.smooth_l1_loss(sampled, clean)}
    noisy, time, hidden = add_noise(net, clean)
    denoiser, noisy = (net.lower, net.lower.merge_latents(noisy, upper)) if lower else (net.upper, noisy)
    return {"latent": F.smooth_l1_loss(denoiser(noisy, time, encoded, hidden), clean)}


def encode_windows(net: SAGENet, frames: Tensor) -> tuple[Tensor, Tensor]:
    """Return world windows (B, T, 252) in network space: rotations (B, T, 132) and inputs (B, T, 54)."""
    sparse, motion = net.normalizer.encode(frames).tensor_split([SPARSE_DIM], -1)
    return motion[..., ROTATION], sparse


@torch.no_grad()
def encode_latents(codes: HalfVQVAE, rotation: Tensor, encoded: Tensor) -> Tensor:
    """Return a trained VQ-VAE's latents (B, T // 2, 384) of rotations (B, T, 132) and inputs (B, T, 54),
    always in float32, because rounding would select other code-vectors."""
    assert not codes.training
    with use_float32(rotation.device):
        return codes.encode(rotation, encoded)[0]


def add_noise(net: SAGENet, clean: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return noisy latents (B, T // 2, 384), their random times (B,), and random hidden joints (B, 22)."""
    noisy, time, _ = net.diffusion.draw_noisy(clean)
    drawn = distributed.draw_rows(lambda like: torch.rand_like(like[:, 0, :HIDDEN_COUNT]), clean) * N_JOINTS
    return noisy, time, F.one_hot(drawn.long(), N_JOINTS).sum(1) > 0
