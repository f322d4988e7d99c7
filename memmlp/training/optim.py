"""The optimisation of a module: optimiser, steps, batches, learning rates, precision, averaged weights.

The classes of the slot `optim` are Optim (AdamW), Muon and ScheduleFree.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.swa_utils import get_ema_multi_avg_fn
from torch.overrides import TorchFunctionMode

from memmlp.common.components import component
from memmlp.common.errors import InputError
from memmlp.common.settings import (
    Settings,
    at_least,
    fraction,
    one_of,
    positive,
    setting,
    steps_or_fraction,
    within,
)

SCHEDULES: dict[str, Callable[[float, float, float], float]] = {
    # Each maps the progress in [0, 1), final rate / first rate and `drop_at` to the factor on the first rate.
    "step": lambda done, final, drop_at: 1.0 if done < drop_at else final,
    "cosine": lambda done, final, drop_at: final + (1 - final) * 0.5 * (1 + math.cos(math.pi * done)),
    "milestones": lambda done, final, drop_at: 0.2 ** sum(done >= at for at in (0.2, 0.5, 0.7)),
}

MATRIX_PRODUCTS = {
    torch.matmul, torch.Tensor.matmul, torch.Tensor.__matmul__, torch.mm, torch.addmm, torch.baddbmm
}  # fmt: skip
"""The matrix products that are computed in float32 where bfloat16 is slow."""


@dataclass
class OptimSettings(Settings):
    """The keys that all optimisers have."""

    steps: int = setting(at_least(1), "${profile.steps}")
    # training compute, TFLOP, including prerequisite runs; it determines `steps`. null: `steps` is used
    tflop: float | None = setting(positive(), None)
    batch: int = setting(at_least(1), "${profile.batch}")  # number of windows per step
    lr: float = setting(positive(), "${profile.lr}")
    weight_decay: float = setting(at_least(0), 1.0e-4)
    # number of initial steps with a growing learning rate; below 1: a fraction of all steps; 0: none
    warmup: int | float = setting(steps_or_fraction(), 0)
    clip_norm: float = setting(at_least(0), 0.0)  # maximum norm of the gradient; 0: no limit
    precision: str = setting(one_of("fp32", "bf16"), "fp32")
    # true: compile network and loss with torch.compile. It needs a C++ compiler. On a CPU it takes half a
    # minute and saves a tenth of every step, so it pays from about 4,000 steps of profile=small.
    compile: bool = setting(default=False)
    # number of steps between checkpoints
    checkpoint_every: int = setting(at_least(1), "${profile.checkpoint_every}")
    # number of steps between validations; below 1: a fraction of all steps
    validate_every: int | float = setting(steps_or_fraction(zero=False), "${profile.validate_every}")
    # number of validation pieces of four seconds, evenly spread over the clips; null: all
    validation_pieces: int | None = setting(at_least(1), None)
    # rotation or position: the weights with this branch's lowest validation MPJPE are kept; null: the last
    best_by: str | None = setting(one_of("rotation", "position"), None)
    # number of steps between metrics log entries
    log_every: int = setting(at_least(1), "${profile.log_every}")

    @classmethod
    def problems(cls, config: Any) -> Iterator[str]:
        own = config["optim"]
        if own.get("final_lr", 0) > own["lr"]:
            yield f"optim.final_lr={own['final_lr']}: must be at most optim.lr={own['lr']}"
        if own["tflop"] is None and own["warmup"] > own["steps"]:
            yield f"optim.warmup={own['warmup']}: must be at most optim.steps={own['steps']}"
        if own["tflop"] is not None and own["warmup"] >= 1:
            yield f"optim.warmup={own['warmup']}: must be below 1, a fraction of the steps, with optim.tflop"
        if own["tflop"] is not None and config["refiner"] is not None:
            yield f"optim.tflop={own['tflop']}: must be null with a refiner; the network uses all of it"


@component("optim", "adamw", builds="Optim")
@dataclass
class AdamWSettings(OptimSettings):
    """Training by AdamW (Sec. 4.1). Batch size and weight decay are AGRoL's (docs/readings.md, no. 12)."""

    final_lr: float = setting(at_least(0), "${profile.final_lr}")  # the final learning rate
    # step: the learning rate drops to final_lr at drop_at; cosine: it decays to final_lr along a half cosine
    schedule: str = setting(one_of("step", "cosine"), "${profile.schedule}")
    drop_at: float = setting(within(0, 1, strict=True), 0.75)  # as a fraction of the steps
    # decay of an exponential moving average of the weights, such as 0.999; evaluation uses this average.
    # null: no average
    ema: float | None = setting(within(0, 1, strict=True), "${profile.ema}")
    eps: float | None = setting(positive(), None)  # Adam's epsilon; null: 1e-8
    # false: weight decay is part of the gradient, as in Adam; null or true: AdamW
    decoupled: bool | None = setting(None, None)


@component("optim", "muon", builds="Muon")
@dataclass
class MuonSettings(AdamWSettings):
    """Training by Muon for matrices and by AdamW for all other parameters (torch.optim.Muon).

    Its steps are as long as AdamW's at the same learning rate.
    """

    momentum: float = setting(fraction(), 0.95)  # momentum of Muon
    other_lr: float | None = setting(positive(), None)  # AdamW's learning rate; null: lr
    # optimiser of parameters with only one column or row, such as the biases of time mixes
    vectors: str = setting(one_of("adamw", "muon"), "adamw")


@component("optim", "schedule_free", builds="ScheduleFree")
@dataclass
class ScheduleFreeSettings(OptimSettings):
    """Training by schedule-free AdamW, which averages the weights itself.

    It needs pip install 'memmlp[schedulefree]'.
    The learning rate does not fall after the warm-up.
    """


@dataclass(frozen=True)
class Optim:
    """The optimisation of a module: by AdamW, or by the optimiser of a subclass. Attributes that are not keys
    of AdamWSettings: `batch`, windows (VQ-VAE: frames) per step; `schedule`, a name in SCHEDULES, of which
    "milestones" is for VQ-VAEs (App. A); `betas`, Adam's decay rates; `decoupled`, whether weight decay is
    decoupled."""

    steps: int
    batch: int
    lr: float
    final_lr: float = 0.0
    schedule: str = "step"
    drop_at: float = 0.75
    warmup: float = 0
    ema: float | None = None
    weight_decay: float = 1e-4
    betas: tuple[float, float] = (0.9, 0.999)
    decoupled: bool | None = True
    clip_norm: float = 0.0
    precision: str = "fp32"
    compile: bool = False
    eps: float | None = None
    checkpoint_every: int = 500
    validate_every: float = 1000
    log_every: int = 50
    tflop: float | None = None
    best_by: str | None = None
    validation_pieces: int | None = None

    def with_lr(self, lr: float | None) -> Self:
        """Return a copy with another initial learning rate and a proportional final rate; None changes
        nothing."""
        return self if lr is None else replace(self, lr=lr, final_lr=self.final_lr * lr / self.lr)

    def resolve(self, step_tflop: float, spent: float | None = 0.0) -> Self:
        """Return a copy with whole numbers of steps, instead of a compute budget and fractions. `step_tflop`
        is the compute of a training step, `spent` that of the prerequisite runs. Raises InputError if the
        budget `tflop` is too small for a step, or `spent` is unknown."""
        steps = self.steps
        if self.tflop is not None and spent is None:
            raise InputError("optim.tflop: the prerequisite run did not record its compute; remove it")
        if self.tflop is not None:
            steps = round((self.tflop - (spent or 0)) / step_tflop)
            if steps < 1:
                least = f"{spent:.3g} TFLOP of prerequisite runs and {step_tflop:.3g} of each step"
                raise InputError(f"optim.tflop={self.tflop:g}: must be above {least}")
        warmup, often = (int(one if one >= 1 else one * steps) for one in (self.warmup, self.validate_every))
        return replace(self, steps=steps, warmup=warmup, validate_every=max(often, 1))

    def compute_factor(self, step: int) -> float:
        """Return the learning rate at a step as a fraction of the initial learning rate."""
        course = SCHEDULES[self.schedule](step / self.steps, self.final_lr / self.lr, self.drop_at)
        return self.compute_warmup_factor(step) * course

    def compute_warmup_factor(self, step: int) -> float:
        """Return the warm-up's factor on the learning rate at a step, in (0, 1]."""
        return min(1.0, (step + 1) / self.warmup) if self.warmup else 1.0

    @property
    def length(self) -> str:
        """The length of the training in words, such as "2000 steps"."""
        return f"{self.steps} steps" if self.tflop is None else f"{self.tflop:g} TFLOP"

    def check_installed(self) -> None:
        """Raise InputError if the optimiser's library is not installed."""

    def build(self, groups: list[dict]) -> Optimizer:
        """Make the optimiser for parameter groups; a group's own `lr` and `weight_decay` take precedence."""
        return self.build_adam(groups)

    def build_adam(self, groups: list[dict]) -> Optimizer:
        """Make Adam or AdamW for parameter groups."""
        kind = torch.optim.Adam if self.decoupled is False else torch.optim.AdamW
        eps = self.eps or 1e-8
        return kind(groups, self.lr, self.betas, eps, weight_decay=self.weight_decay, fused=True)

    def make_average(self, module: nn.Module, optimiser: Optimizer) -> Average:
        """Return the average over steps that provides the final weights; without EMA, the last weights."""
        return EMA(module, self.ema) if self.ema else Average(module)


@dataclass(frozen=True)
class Muon(Optim):
    """Optimisation by Muon for matrices, and by AdamW for all other parameters (Jordan et al. 2024). Muon's
    steps are scaled to the typical length of AdamW's (Liu et al. 2025), so AdamW's learning rates and weight
    decay suit both. Like torch.optim.Muon, it multiplies in bfloat16 and uses Nesterov momentum."""

    momentum: float = 0.95
    other_lr: float | None = None
    vectors: str = "adamw"

    def with_lr(self, lr: float | None) -> Self:
        """Return a copy with another learning rate; `other_lr` is scaled by the same factor."""
        other = super().with_lr(lr)
        if lr is None or self.other_lr is None:
            return other
        return replace(other, other_lr=self.other_lr * lr / self.lr)

    def check_installed(self) -> None:
        if not hasattr(torch.optim, "Muon"):
            raise InputError(f"optim=muon: needs torch 2.9 or newer, not {torch.__version__}")

    def build(self, groups: list[dict]) -> Optimizer:
        self.check_installed()
        matrices, rest = _split_matrices(groups, least=1 if self.vectors == "muon" else 2)
        parts: list[Optimizer] = []
        if matrices:
            keys = self.lr, self.weight_decay, self.momentum
            parts.append(BatchedMuon(matrices, *keys, adjust_lr_fn="match_rms_adamw"))
        if rest:
            parts.append(replace(self, lr=self.other_lr or self.lr, decoupled=True).build_adam(rest))
        return ComposedOptimiser(parts)


@dataclass(frozen=True)
class ScheduleFree(Optim):
    """Optimisation by schedule-free AdamW (Defazio et al. 2024) of the package schedulefree. It averages the
    weights itself; `schedule`, `final_lr`, `drop_at` and `ema` have no effect."""

    def compute_factor(self, step: int) -> float:
        return self.compute_warmup_factor(step)

    def check_installed(self) -> None:
        if find_spec("schedulefree") is None:
            raise InputError("optim=schedule_free: needs schedulefree: pip install 'memmlp[schedulefree]'")

    def build(self, groups: list[dict]) -> Optimizer:
        self.check_installed()
        from schedulefree import AdamWScheduleFree

        optimiser = AdamWScheduleFree(groups, self.lr, self.betas, weight_decay=self.weight_decay)
        optimiser.train()
        return optimiser

    def make_average(self, module: nn.Module, optimiser: Optimizer) -> Average:
        return ScheduleFreeAverage(module, optimiser)


def _split_matrices(groups: list[dict], least: int) -> tuple[list[dict], list[dict]]:
    """Divide parameter groups into matrices with at least `least` rows and columns, and other parameters."""
    parts: tuple[list[dict], list[dict]] = ([], [])
    for group in groups:
        for chosen, matrices in zip(parts, (True, False), strict=True):
            own = [one for one in group["params"] if (one.dim() == 2 and min(one.shape) >= least) == matrices]
            chosen += [{**group, "params": own}] if own else []
    return parts


def make_vqvae_optim(steps: int, **keys: Any) -> Optim:
    """Make a VQ-VAE's optimisation: Adam; its rate is multiplied by 0.2 at 20, 50 and 70 % of the steps.
    Validation is done once, at the end; `keys` are further attributes of Optim."""
    return Optim(
        steps, schedule="milestones", betas=(0.9, 0.99), decoupled=False, validate_every=steps, **keys
    )


class BatchedMuon(getattr(torch.optim, "Muon", Optimizer)):  # type: ignore[misc]
    """torch.optim.Muon with matrices of one shape in one batch: equal, in half the time on a CPU."""

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> None:
        """Take a step; a closure is not supported."""
        for group in self.param_groups:
            parameters = [one for one in group["params"] if one.grad is not None]
            grads = [one.grad for one in parameters]
            for one in parameters:
                if not self.state[one]:
                    self.state[one]["momentum_buffer"] = torch.zeros_like(one)
            buffers = [self.state[one]["momentum_buffer"] for one in parameters]
            torch._foreach_lerp_(buffers, grads, 1 - group["momentum"])
            updates = torch._foreach_lerp(grads, buffers, group["momentum"])
            torch._foreach_mul_(parameters, 1 - group["lr"] * group["weight_decay"])
            for shape in {one.shape for one in parameters}:
                own = [index for index, one in enumerate(parameters) if one.shape == shape]
                made = orthogonalise(torch.stack([updates[index] for index in own]), group)
                for index, update in zip(own, made, strict=True):
                    parameters[index].add_(update, alpha=-group["lr"] * 0.2 * math.sqrt(max(shape)))


def orthogonalise(matrices: Tensor, group: Mapping[str, Any]) -> Tensor:
    """Return nearly orthogonal matrices (B, m, n), bfloat16, by torch.optim.Muon's Newton-Schulz iteration.
    `group` is a parameter group of torch.optim.Muon, with the iteration's settings."""
    a, b, c = group["ns_coefficients"]
    tall = matrices.shape[1] > matrices.shape[2]
    x = matrices.bfloat16().mT if tall else matrices.bfloat16()
    x = x / x.flatten(1).norm(dim=1)[:, None, None].clamp(min=group["eps"])
    for _ in range(group["ns_steps"]):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.mT if tall else x


class ComposedOptimiser(Optimizer):
    """One optimiser made of several, with all their parameter groups and states; they must not share
    parameters."""

    def __init__(self, parts: Sequence[Optimizer]):
        self.parts = tuple(parts)
        super().__init__([group for part in parts for group in part.param_groups], {})
        self._share_groups()

    def _share_groups(self) -> None:
        start = 0
        for part in self.parts:  # each uses the groups and the state themselves, not copies
            end = start + len(part.param_groups)
            part.param_groups, part.state = self.param_groups[start:end], self.state
            start = end

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> None:  # type: ignore[override]
        """Take a step of each part; a closure is not supported."""
        with nullcontext() if has_bfloat16_products() else Float32Products():
            for part in self.parts:
                part.step()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load the groups and the state of all parts."""
        super().load_state_dict(state_dict)
        self._share_groups()


class Float32Products(TorchFunctionMode):
    """A context that computes products of bfloat16 matrices on the CPU in float32, then rounds them. Without
    bfloat16 instructions this is six times faster. The results are equal: products of two bfloat16 numbers
    are exact in float32, and sums are in float32 with both methods."""

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Sequence[type],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        if func in MATRIX_PRODUCTS and all(map(_is_bfloat16_on_cpu, args)):
            return func(*(tensor.float() for tensor in args), **(kwargs or {})).bfloat16()
        return func(*args, **(kwargs or {}))


@functools.cache
def has_bfloat16_products() -> bool:
    """Return whether this processor has bfloat16 instructions; processors other than x86 are not checked."""
    ask: Callable[[], dict[str, Any]] = getattr(torch.cpu, "get_capabilities", dict)  # newer than some torch
    known = ask()
    return known.get("architecture") != "x86_64" or bool(known.get("avx512_bf16") or known.get("amx_bf16"))


def _is_bfloat16_on_cpu(tensor: Any) -> bool:
    return isinstance(tensor, Tensor) and tensor.dtype == torch.bfloat16 and tensor.device.type == "cpu"


class Average:
    """The final weights of a module, which are validated and kept after the training. In this base class
    these are the weights of the last step; a subclass may average over the steps. A checkpoint holds both, so
    a resumed training continues exactly. Only parameters are averaged; buffers, such as a codebook's
    statistics, keep the last step's values."""

    def __init__(self, module: nn.Module):
        self.parameters = dict(module.named_parameters())

    def update(self, steps: int) -> None:
        """Update the average with the module's weights after `steps` steps."""

    def write_into_module(self) -> None:
        """Write the final weights into the module."""

    def tensors(self) -> dict[str, Tensor]:
        """Return the average's tensors for a checkpoint; their names begin with "average."."""
        return {}

    def load(self, tensors: dict[str, Tensor]) -> None:
        """Restore the average from a checkpoint's tensors. Names without "average." are ignored."""

    @contextmanager
    def use_average(self) -> Iterator[None]:
        """Use the final weights within the context, then restore the last step's weights bit for bit."""
        before = {name: one.detach().clone() for name, one in self.parameters.items()}
        self.write_into_module()
        try:
            yield
        finally:
            self._write_parameters(before)

    @torch.no_grad()
    def _write_parameters(self, values: dict[str, Tensor]) -> None:
        for name, one in self.parameters.items():
            one.copy_(values[name])


class EMA(Average):
    """An exponential moving average of the weights; each step keeps the fraction `decay` in (0, 1) of the old
    average. The decay first grows as (1 + steps) / (10 + steps), so that the random initial weights are soon
    forgotten."""

    def __init__(self, module: nn.Module, decay: float):
        super().__init__(module)
        self.decay = decay
        self.averages = {name: one.detach().clone() for name, one in self.parameters.items()}

    def update(self, steps: int) -> None:
        decay = min(self.decay, (1 + steps) / (10 + steps))
        weights = [one.detach() for one in self.parameters.values()]
        get_ema_multi_avg_fn(decay)(list(self.averages.values()), weights, steps)

    def write_into_module(self) -> None:
        self._write_parameters(self.averages)

    def tensors(self) -> dict[str, Tensor]:
        return {f"average.{name}": value for name, value in self.averages.items()}

    def load(self, tensors: dict[str, Tensor]) -> None:
        for name, value in self.averages.items():
            value.copy_(tensors[f"average.{name}"])


class ScheduleFreeAverage(Average):
    """The average that a schedule-free optimiser maintains; its evaluation mode writes it into the module."""

    COUNTERS = ("k", "weight_sum", "lr_max")
    """The counters in the optimiser's groups: steps, sum of the average's weights, largest learning rate."""

    def __init__(self, module: nn.Module, optimiser: Optimizer):
        super().__init__(module)
        self.optimiser = optimiser

    def write_into_module(self) -> None:
        self.optimiser.eval()  # type: ignore[attr-defined]

    @contextmanager
    def use_average(self) -> Iterator[None]:
        # The optimiser can restore the last step's weights by itself, but not bit for bit.
        with super().use_average():
            yield
            self.optimiser.train()  # type: ignore[attr-defined]

    def tensors(self) -> dict[str, Tensor]:
        counted = [[group[name] for name in self.COUNTERS] for group in self.optimiser.param_groups]
        return {"average.counters": torch.tensor(counted, dtype=torch.float64)}

    def load(self, tensors: dict[str, Tensor]) -> None:
        counted = tensors["average.counters"].tolist()
        for group, (steps, weight_sum, lr_max) in zip(self.optimiser.param_groups, counted, strict=True):
            group.update(zip(self.COUNTERS, (int(steps), weight_sum, lr_max), strict=True))
