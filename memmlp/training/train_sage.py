"""How SAGE-Net's parts are trained, one after the other, before the whole network (Feng et al., CVPR 2024).

The parts are a VQ-VAE for each half of the body, the diffusion model of the upper half's latents, that of the
lower half's latents given the upper latents that the first model predicts, and the decoder of what both
predict. Each part is a run of its own, whose file holds all parts trained so far. Finished parts stay frozen.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from memmlp.common import distributed
from memmlp.motion.dataset import MotionDataset, WindowSampler
from memmlp.motion.mirror import MirroredDataset
from memmlp.motion.motion_source import Prepared
from memmlp.networks import checkpoint
from memmlp.networks.architectures import Architecture, PartedArchitecture
from memmlp.networks.sage_net import SAGENet
from memmlp.networks.sage_parts import LOWER, UPPER
from memmlp.runs.run import Run
from memmlp.training.loop import StepResult, train
from memmlp.training.optim import Optim
from memmlp.training.sage_part_losses import Objective, objective
from memmlp.training.train_network import NetworkTraining

PARTS = ("upper_codes", "lower_codes", "upper_diffusion", "lower_diffusion", "decoder")
"""In the order of their training; each builds upon the one before."""

VALIDATION_WINDOWS = 256

_SIZES = ("name", "frames", "code_width", "code_depth", "code_heads", "dropout")
_DENOISER = (*_SIZES, "width", "depth", "heads", "diffusion_steps")
_ALL = (*_DENOISER, "sampling_steps", "noise", "noise_seed")
ACTING: dict[str, tuple[str, ...]] = {
    "upper_codes": _SIZES,
    "lower_codes": _SIZES,
    "upper_diffusion": _DENOISER,
    "lower_diffusion": _ALL,  # it sees what the upper one samples
    "decoder": _ALL,
}
"""The keys of the model that act in the training of each part."""


WHOLE = ("warmup", "ema", "clip_norm", "weight_decay", "compile")
"""The keys of optim, beside the optimiser, that act for the whole network alone: parts have defaults."""


@dataclass(frozen=True)
class DroppingOptim(Optim):
    """AdamW with a learning rate that falls at some steps.

    Attributes:
        lr_drops_at: fractions of the steps at which the learning rate falls.
        lr_drop: factor by which it is multiplied at each of them.
    """

    lr_drops_at: Sequence[float] = ()
    lr_drop: float = 1.0

    def factor(self, step: int) -> float:
        """Return the learning rate at a step as a fraction of the learning rate at the start."""
        return self.lr_drop ** sum(step >= at * self.steps for at in self.lr_drops_at)


@dataclass(frozen=True)
class SAGEUpstream:
    """The steps, batch, lr and its drops with which each part is trained."""

    upper_codes: Mapping[str, Any]
    lower_codes: Mapping[str, Any]
    upper_diffusion: Mapping[str, Any]
    lower_diffusion: Mapping[str, Any]
    decoder: Mapping[str, Any]

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
            only = of_whole(config["optim"]["name"], network.optim, optim)
            yield make(kind, acting(kind, config), replace(network, optim=optim), only)


def of_whole(name: str, whole: Optim, part: Optim) -> tuple[str, ...]:
    """Return the settings of optim that a part does not use, such as "optim.warmup=100"."""
    other = () if name == "adamw" else (f"optim={name}",)
    own = {key: getattr(whole, key, None) for key in WHOLE}
    return (*other, *(f"optim.{key}={own[key]}" for key in WHOLE if own[key] != getattr(part, key)))


def acting(kind: str, config: Mapping[str, Any]) -> dict[str, Any]:
    """Return those keys of a network's config that determine the result of training one of its parts."""
    upstream = {key: config["upstream"][key] for key in ("name", "_target_", kind)}
    own = {key: config[key] for key in ("profile", "data", "normalizer", "seed")}
    own |= {"loss": config["loss"]} if kind == "decoder" else {}
    return {
        **own,
        "model": {key: config["model"][key] for key in ACTING[kind]},
        "upstream": upstream,
        "optim": {"precision": config["optim"]["precision"]},
    }


@dataclass(frozen=True)
class PartTraining:
    """How a part is trained, as a run of its own.

    Attributes:
        kind: which of PARTS.
        config: the part of the resolved config that determines the result.
        network: seed, optimisation, and how windows are drawn.
        of_whole: settings of optim that act in the training of the whole network alone.
    """

    kind: str
    config: dict[str, Any]
    network: NetworkTraining
    of_whole: tuple[str, ...] = ()

    @property
    def told(self) -> str:
        """What the training does, in words, and which settings it leaves to that of the whole."""
        steps = f"{self.kind.replace('_', ' ')}: train it for {self.network.optim.steps} steps"
        left = f" by AdamW; {', '.join(self.of_whole)}: of the whole alone" if self.of_whole else ""
        return steps + left

    def train(
        self,
        architecture: Architecture,
        data: Prepared,
        upstream: Path | None,
        run: Run,
        device: torch.device,
    ) -> dict[str, float]:
        """Train the part, from the run's checkpoint if there is one, and write it with the parts before it.

        Args:
            architecture: builds the whole network.
            data: the prepared motion.
            upstream: file of the parts that were trained before; None for the first part.
            run: the run whose folder takes checkpoints, log and weights.
            device: the device to train on.

        Returns:
            The part's errors on windows of the validation part.
        """
        before, dataset = checkpoint.read(upstream)[0] if upstream else {}, data.open("train").to(device)
        torch.manual_seed(self.network.seed)
        net = architecture.build(architecture.normalizer(data.manifest, dataset.frames), None)
        assert isinstance(net, SAGENet)
        parts: dict[str, nn.Module] = {"codes.upper": net.codes(UPPER), "codes.lower": net.codes(LOWER)}
        parts |= {"model.upper": net.upper, "model.lower": net.lower}
        *earlier, (name, part) = islice(parts.items(), PARTS.index(self.kind) + 1)
        for finished, module in earlier:
            checkpoint.load_module(finished, module, before)
        halves = nn.ModuleDict({"net": net, "upper": parts["codes.upper"], "lower": parts["codes.lower"]})
        halves.eval().requires_grad_(False).to(device)
        windows = Windows(self.network, dataset, data.open("val").to(device), net.frames)
        task = PartTask(part.requires_grad_(True), objective(self.kind, halves), windows)
        train(task, self.network.optim, run, self.network.seed, self.kind.replace("_", " "))
        if distributed.first():
            checkpoint.write(run.model, before | checkpoint.module_tensors(name, part), {})
        return last_errors(run)


@dataclass(frozen=True)
class DecoderTraining(PartTraining):
    """How the decoder is trained: like the whole network, on what the finished diffusion models predict."""

    def train(
        self,
        architecture: Architecture,
        data: Prepared,
        upstream: Path | None,
        run: Run,
        device: torch.device,
    ) -> dict[str, float]:
        """Train the decoder and write it together with the diffusion models; see PartTraining."""
        assert isinstance(architecture, PartedArchitecture)
        fixed = replace(architecture, finished=("upper", "lower"))
        self.network.train(fixed, data, upstream, run, device)
        return last_errors(run)


def last_errors(run: Run) -> dict[str, float]:
    """Return the errors of a run's last validation; empty in a process that does not validate."""
    found = [entry.values for entry in run.metrics() if entry.phase == "val"]
    return dict(found[-1]) if found else {}


class Windows:
    """Draws the windows with which a part is trained, and those on which it is validated."""

    def __init__(
        self, network: NetworkTraining, dataset: MotionDataset, validation: MotionDataset, frames: int
    ):
        self.dataset = MirroredDataset(dataset) if network.mirror else dataset
        draws = network.optim.batch, frames, network.seed, network.drawn_by, network.shares
        self.frames, self.sampler = frames, WindowSampler(self.dataset, *draws)
        drawn = WindowSampler(validation, VALIDATION_WINDOWS, frames, seed=0).draw(0)
        self.validation = validation.stretches(*drawn, frames)

    def draw(self, step: int) -> tuple[Tensor, Tensor]:
        """Return the world frames (B, T, 252) of a step's windows, and the indices (B,) of their clips."""
        clips, end = map(distributed.own_rows, self.sampler.draw(step))
        return self.dataset.stretches(clips, end, self.frames), clips


class PartTask:
    """The training task of a part: the sum of an objective's losses."""

    def __init__(self, part: nn.Module, objective: Objective, windows: Windows):
        self.module, self.objective, self.windows = part, objective, windows
        self.dataset = windows.dataset

    def parameter_groups(self) -> list[dict]:
        """Return the part's parameters."""
        return [{"params": list(self.module.parameters())}]

    def step(self, step: int) -> StepResult:
        """Compute the losses on a batch of windows."""
        frames, clips = self.windows.draw(step)
        terms = self.objective(frames, True)
        return StepResult(torch.stack(list(terms.values())).sum(), terms, clips)

    def report(self) -> dict[str, float]:
        """Return nothing: no values are logged besides the loss terms."""
        return {}

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Compute the losses on the validation windows, with no joints hidden and with sampled latents."""
        return {name: float(term) for name, term in self.objective(self.windows.validation, False).items()}
