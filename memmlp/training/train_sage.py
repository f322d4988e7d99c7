"""How SAGE-Net's parts are trained, one after the other, before the whole network (Feng et al., CVPR 2024).

The parts are a VQ-VAE for each half of the body, the diffusion model of the upper half's latents, that of the
lower half's latents given the upper latents that the first model predicts, and the decoder of what both
predict. Each part is a run of its own, whose file holds all parts trained so far. Finished parts stay frozen.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.common import distributed
from memmlp.common.components import component
from memmlp.common.settings import Settings, at_least, each, fraction, group, positive, setting, sized
from memmlp.motion.body import HANDS, HEAD, N_JOINTS, ROOT, ROTATION, SPARSE_DIM, SPARSE_POSITION
from memmlp.motion.dataset import MirroredDataset, MotionDataset, WindowSampler
from memmlp.motion.motion_source import Prepared
from memmlp.motion.normalizer import in_float32
from memmlp.networks import checkpoint
from memmlp.networks.architectures import Architecture
from memmlp.networks.sage_net import SAGENet
from memmlp.networks.sage_parts import HIDDEN, LOWER, UPPER, HalfVQVAE
from memmlp.runs.run import Run
from memmlp.training.loop import StepResult, TrainingTask, ValidationCallback, train
from memmlp.training.losses.terms import Body
from memmlp.training.optim import Optim
from memmlp.training.train_network import NetworkTraining, Training, read_last_errors

PARTS = ("upper_codes", "lower_codes", "upper_diffusion", "lower_diffusion", "decoder")
"""In the order of their training; each builds upon the one before."""

VALIDATION_WINDOWS = 256
HIDDEN_SHARE = 0.5  # of a half's joints, which its VQ-VAE has to guess
HIDDEN_COUNT = 2  # joints of the diffusion models' condition, drawn with replacement
CODE_WEIGHTS = {"orientation": 0.2, "rotation": 1.0, "position": 5.0, "hand": 5.0, "codebook": 0.25}


@dataclass(frozen=True)
class DroppingOptim(Optim):
    """AdamW with a learning rate that falls at some steps.

    Attributes:
        lr_drops_at: fractions of the steps at which the learning rate falls.
        lr_drop: factor by which it is multiplied at each of them.
    """

    lr_drops_at: Sequence[float] = ()
    lr_drop: float = 1.0

    def compute_factor(self, step: int) -> float:
        return self.lr_drop ** sum(step >= at * self.steps for at in self.lr_drops_at)


@dataclass
class PartSettings:
    """How a part is trained: by AdamW with a weight decay of 1e-4."""

    steps: int = setting(at_least(1), sized(20, 2000, 188000))
    batch: int = setting(at_least(1), sized(8, 32, 512))  # windows a step
    lr: float = setting(positive(), sized(1.0e-3, 1.0e-3, 1.0e-4))
    lr_drops_at: list[float] = setting(each(fraction(), empty=True), [0.75])  # fractions of the steps
    lr_drop: float = setting(positive(), 0.25)  # by which the learning rate is multiplied at each of these


@component("prerequisite", "sage", version=3)
@dataclass
class SAGEPrerequisiteSettings(Settings):
    """The training of SAGE-Net's parts before the whole network (Feng et al. 2024), each in a run of its own.

    Learning rates and their falls are its authors'; at profile=paper steps draw as many windows as epochs.
    Of optim, precision and the intervals act here; its optimiser, warmup, ema, clip_norm, weight_decay and
    compile only act in the training of the whole.
    """

    upper_codes: PartSettings = group(PartSettings)  # the VQ-VAE of the upper half of the body
    lower_codes: PartSettings = group(PartSettings)  # the VQ-VAE of the lower half
    # the diffusion model of the upper half's latents
    upper_diffusion: PartSettings = group(
        PartSettings,
        steps=sized(20, 2000, 240000),
        lr=sized(1.0e-3, 1.0e-3, 2.0e-4),
        lr_drops_at=[0.392, 0.588],
    )
    # the diffusion model of the lower half's latents, given the upper ones that the first predicts
    lower_diffusion: PartSettings = group(
        PartSettings,
        steps=sized(20, 2000, 193000),
        lr=sized(1.0e-3, 1.0e-3, 2.0e-4),
        lr_drops_at=[0.366, 0.488],
        lr_drop=0.2,
    )
    # the decoder of what both predict
    decoder: PartSettings = group(
        PartSettings, steps=sized(20, 1000, 56000), batch="${profile.batch}", lr_drops_at=[], lr_drop=1.0
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
    """The keys of the model that have an effect on the training of each part."""

    @classmethod
    def prerequisites(cls, config: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield each part with those keys of the network's config that determine its result, in order."""
        for kind in PARTS:
            loss = {"loss": config["loss"]} if kind == "decoder" else {}
            yield (
                kind,
                {
                    **{key: config[key] for key in ("profile", "data", "normalizer", "seed")},
                    **loss,
                    "model": {key: config["model"][key] for key in cls.model_keys[kind]},
                    "prerequisite": {key: config["prerequisite"][key] for key in ("name", kind)},
                    "optim": {"precision": config["optim"]["precision"]},
                },
            )

    def trainings(self, config: Mapping[str, Any], network: NetworkTraining) -> Iterator[PartTraining]:
        """Yield the training of each part, in order.

        Args:
            config: the resolved config of the whole network.
            network: how the whole network is trained; windows are drawn in the same way for its parts.
        """
        same = ("checkpoint_every", "log_every", "precision")
        often = {name: getattr(network.optim, name) for name in same}
        for kind in PARTS:
            own = getattr(self, kind)
            betas = (0.9, 0.99) if kind in ("upper_codes", "lower_codes") else (0.9, 0.999)
            optim = DroppingOptim(**own, **often, betas=betas, validate_every=own["steps"])
            make = DecoderTraining if kind == "decoder" else PartTraining
            yield make(kind, replace(network, optim=optim))


@dataclass(frozen=True)
class PartTraining(Training):
    """How a part is trained, as a run of its own.

    Attributes:
        kind: which of PARTS.
        network: seed, optimisation, and how windows are drawn.
    """

    kind: str
    network: NetworkTraining

    @property
    def description(self) -> str:
        """What the training does, in words."""
        return f"{self.kind.replace('_', ' ')}: train it for {self.network.optim.steps} steps"

    def train(
        self,
        architecture: Architecture,
        data: Prepared,
        prerequisite: Path | None,
        run: Run,
        device: torch.device,
        on_validation: ValidationCallback | None = None,
    ) -> dict[str, float]:
        """Train the part and write it with the parts before it; see Training."""
        before = checkpoint.read(prerequisite)[0] if prerequisite else {}
        dataset = data.open("train").to(device)
        torch.manual_seed(self.network.seed)
        net = architecture.build(architecture.make_normalizer(data.manifest, dataset.frames), None)
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
        objective, validation = make_objective(self.kind, halves), data.open("val").to(device)
        task = PartTask(part.requires_grad_(True), objective, self.network, dataset, validation, net.frames)
        train(task, self.network.optim, run, self.network.seed, self.kind.replace("_", " "), on_validation)
        if distributed.is_first():
            checkpoint.write(run.model, before | checkpoint.module_tensors(name, part), {})
        return read_last_errors(run)


@dataclass(frozen=True)
class DecoderTraining(PartTraining):
    """How the decoder is trained: like the whole network, on what the finished diffusion models predict."""

    def train(
        self,
        architecture: Architecture,
        data: Prepared,
        prerequisite: Path | None,
        run: Run,
        device: torch.device,
        on_validation: ValidationCallback | None = None,
    ) -> dict[str, float]:
        """Train the decoder and write it together with the diffusion models; see Training."""
        fixed = replace(architecture, trained_parts=("upper", "lower"))
        return self.network.train(fixed, data, prerequisite, run, device, on_validation)


class PartTask(TrainingTask):
    """The training task of a part: the sum of an objective's losses, on windows of T frames."""

    def __init__(
        self,
        part: nn.Module,
        objective: Objective,
        network: NetworkTraining,
        dataset: MotionDataset,
        validation: MotionDataset,
        frames: int,
    ):
        self.module, self.objective, self.frames = part, objective, frames
        self.dataset = MirroredDataset(dataset) if network.mirror else dataset
        draws = network.optim.batch, frames, network.seed, network.drawn_by, network.shares
        self.sampler = WindowSampler(self.dataset, *draws)
        drawn = WindowSampler(validation, VALIDATION_WINDOWS, frames, seed=0).draw(0)
        self.validation = validation.stretches(*drawn, frames)

    def step(self, step: int) -> StepResult:
        """Compute the losses on a batch of windows."""
        clips, end = map(distributed.take_local_rows, self.sampler.draw(step))
        terms = self.objective(self.dataset.stretches(clips, end, self.frames), True)
        return StepResult(torch.stack(list(terms.values())).sum(), terms, clips)

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Compute the losses on the validation windows, with no joints hidden and with sampled latents."""
        return {name: float(term) for name, term in self.objective(self.validation, False).items()}


Objective = Callable[[Tensor, bool], dict[str, Tensor]]
"""Maps world windows (B, T, 252), and whether it is for training, to weighted losses by name."""


def make_objective(kind: str, halves: nn.ModuleDict) -> Objective:
    """Return the objective that trains a part.

    Args:
        kind: one of PARTS, except "decoder".
        halves: the network ("net"), and the VQ-VAE of each half ("upper", "lower").
    """
    half, of = kind.split("_")
    net, codes = halves["net"], halves[half]
    assert isinstance(net, SAGENet)
    assert isinstance(codes, HalfVQVAE)
    if of == "codes":
        return partial(compute_code_losses, net, codes)
    return partial(compute_latent_losses, net, codes, lower=half == "lower")


def compute_code_losses(net: SAGENet, codes: HalfVQVAE, frames: Tensor, training: bool) -> dict[str, Tensor]:
    """Return the losses of a VQ-VAE: of the last frame's rotations and joints, and of its codebooks.

    In training, random joints of its half except the first are hidden, so that the VQ-VAE has to guess them.
    The half with the hands also has a loss of the hands' positions.

    Args:
        net: the network, whose space the VQ-VAE works in.
        codes: the VQ-VAE.
        frames: world windows (B, T, 252).
        training: whether joints are hidden.
    """
    rotation, encoded = encode_windows(net, frames)
    sixd = rotation.unflatten(-1, (N_JOINTS, 6))
    hidden = distributed.draw_rows(torch.rand_like, sixd[:, 0, :, 0]) < HIDDEN_SHARE
    hidden[:, codes.joints[0]] = False
    shown = sixd.masked_fill(hidden[:, None, :, None], HIDDEN) if training else sixd
    latent, codebook = codes.encode(shown.flatten(-2), encoded)
    made = codes.decode(latent)[:, -1].unflatten(-1, (-1, 6))
    errors = measure_half(net, codes.joints, made, frames[:, -1], sixd[:, -1])
    return {name: CODE_WEIGHTS[name] * term for name, term in (errors | {"codebook": codebook}).items()}


def measure_half(
    net: SAGENet, joints: tuple[int, ...], made: Tensor, frame: Tensor, true: Tensor
) -> dict[str, Tensor]:
    """Return errors of a half's rotations and of its joints by forward kinematics (smooth L1).

    A half contains all ancestors of its joints, so the other joints' rotations do not matter.

    Args:
        net: the network, whose space the rotations are in.
        joints: the half's joints.
        made: the half's predicted rotations (B, J, 6).
        frame: world frames (B, 252).
        true: the true rotations (B, 22, 6) of all joints.
    """
    sparse, own = frame[:, None, :SPARSE_DIM], list(joints)
    full = true.clone()
    full[:, own] = made.to(true)
    motions = [net.normalizer.posed(sixd.flatten(-2)[:, None], sparse) for sixd in (full, true)]
    bodies = [Body(motion, net.normalizer) for motion in motions]
    with in_float32(frame.device):
        (found, placed), (expected, true_placed) = [(one.sixd, one.posed[1]) for one in bodies]
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
    """Return the error of a half's latents (smooth L1); for other arguments see `compute_code_losses`.

    Args:
        lower: whether the half is the lower one, which is given sampled latents of the upper half.
    """
    rotation, encoded = encode_windows(net, frames)
    clean = encode_latents(codes, rotation, encoded)
    with torch.no_grad():
        upper = net.sample_upper(encoded) if lower or not training else clean
    if not training:
        sampled = net.sample_lower(upper, encoded) if lower else upper
        return {"latent": F.smooth_l1_loss(sampled, clean)}
    noisy, time, hidden = add_noise(net, clean)
    denoiser, noisy = (net.lower, net.lower.join(noisy, upper)) if lower else (net.upper, noisy)
    return {"latent": F.smooth_l1_loss(denoiser(noisy, time, encoded, hidden), clean)}


def encode_windows(net: SAGENet, frames: Tensor) -> tuple[Tensor, Tensor]:
    """Return world windows (B, T, 252) in network space: rotations (B, T, 132) and inputs (B, T, 54)."""
    sparse, motion = net.normalizer.encode(frames).tensor_split([SPARSE_DIM], -1)
    return motion[..., ROTATION], sparse


@torch.no_grad()
def encode_latents(codes: HalfVQVAE, rotation: Tensor, encoded: Tensor) -> Tensor:
    """Return a trained VQ-VAE's latents (B, T // 2, 384) of rotations (B, T, 132) and inputs (B, T, 54).

    They are computed in float32 in a mixed-precision training, too: rounded ones have other code-vectors.
    """
    assert not codes.training
    with in_float32(rotation.device):
        return codes.encode(rotation, encoded)[0]


def add_noise(net: SAGENet, clean: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return noisy latents (B, T // 2, 384), their random times (B,), and random hidden joints (B, 22)."""
    noisy, time, _ = net.diffusion.draw_noisy(clean)
    drawn = distributed.draw_rows(lambda like: torch.rand_like(like[:, 0, :HIDDEN_COUNT]), clean) * N_JOINTS
    return noisy, time, F.one_hot(drawn.long(), N_JOINTS).sum(1) > 0
