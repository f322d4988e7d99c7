"""How a module is optimised: optimiser, steps, batches, learning rates, precision, averaged weights.

The classes of the slot `optim` are Optim (AdamW), Muon and ScheduleFree.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
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
from memmlp.common.settings import Settings, at_least, fraction, one_of, positive, setting, within

SCHEDULES: dict[str, Callable[[float, float, float], float]] = {
    # Each maps the progress in [0, 1), final rate / first rate and `drop_at` to the factor on the first rate.
    "step": lambda done, final, drop_at: 1.0 if done < drop_at else final,
    "cosine": lambda done, final, drop_at: final + (1 - final) * 0.5 * (1 + math.cos(math.pi * done)),
    "milestones": lambda done, final, drop_at: 0.2 ** sum(done >= at for at in (0.2, 0.5, 0.7)),
}

PRODUCTS = {torch.matmul, torch.Tensor.matmul, torch.Tensor.__matmul__, torch.mm, torch.addmm}
"""The products of matrices that are computed in float32 where bfloat16 is slow."""


@dataclass
class OptimSettings(Settings):
    """The keys that all optimisers have."""

    steps: int = setting(at_least(1), "${profile.steps}")
    batch: int = setting(at_least(1), "${profile.batch}")  # windows a step
    lr: float = setting(positive(), "${profile.lr}")
    weight_decay: float = setting(at_least(0), 1.0e-4)
    warmup: int = setting(at_least(0), 0)  # steps over which the learning rate first grows; 0 for none
    clip_norm: float = setting(at_least(0), 0.0)  # the largest norm of the gradient; 0 for no limit
    precision: str = setting(one_of("fp32", "bf16"), "fp32")
    compile: bool = setting(default=False)  # true: torch.compile the network
    checkpoint_every: int = setting(at_least(1), "${profile.checkpoint_every}")  # steps between checkpoints
    validate_every: int = setting(at_least(1), "${profile.validate_every}")  # steps between validations
    log_every: int = setting(at_least(1), "${profile.log_every}")  # steps between entries of the metrics log

    @classmethod
    def problems(cls, config: Any) -> Iterator[str]:
        """Yield which values cannot be combined; see Settings."""
        own = config["optim"]
        if own.get("final_lr", 0) > own["lr"]:
            yield f"optim.final_lr={own['final_lr']}: must be at most optim.lr={own['lr']}"
        if own["warmup"] > own["steps"]:
            yield f"optim.warmup={own['warmup']}: must be at most optim.steps={own['steps']}"


@component("optim", "adamw", builds="Optim")
@dataclass
class AdamWSettings(OptimSettings):
    """Training by AdamW (Sec. 4.1). Batch and weight decay are AGRoL's (reading 12)."""

    final_lr: float = setting(at_least(0), "${profile.final_lr}")  # the learning rate at the end
    # step: falls to final_lr at drop_at; cosine: falls to it along a half cosine
    schedule: str = setting(one_of("step", "cosine"), "${profile.schedule}")
    drop_at: float = setting(within(0, 1, strict=True), 0.75)  # a fraction of the steps: 225 K of 300 K
    # decay of an exponential moving average of the weights, such as 0.999, which is what counts; null for
    # none
    ema: float | None = setting(within(0, 1, strict=True), "${profile.ema}")


@component("optim", "muon", builds="Muon")
@dataclass
class MuonSettings(AdamWSettings):
    """Training by Muon for matrices and AdamW for all else (torch.optim.Muon).

    Its steps are as long as AdamW's at the same learning rate.
    """

    momentum: float = setting(fraction(), 0.95)  # Muon's
    other_lr: float | None = setting(positive(), None)  # learning rate of all but matrices; null: lr
    # which optimises parameters with one column or row, such as the biases of time mixes
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
    """How a module is optimised: by AdamW, unless a subclass says otherwise.

    The attributes are the keys of AdamWSettings, except for these.

    Attributes:
        batch: windows per step; for a VQ-VAE, frames per step.
        schedule: also "milestones", outside the config: times 0.2 at 20, 50 and 70 % of the steps (App. A).
        betas: Adam's two decay rates.
        decoupled: whether weight decay is AdamW's; otherwise it is Adam's.
    """

    steps: int
    batch: int
    lr: float
    final_lr: float = 0.0
    schedule: str = "step"
    drop_at: float = 0.75
    warmup: int = 0
    ema: float | None = None
    weight_decay: float = 1e-4
    betas: tuple[float, float] = (0.9, 0.999)
    decoupled: bool = True
    clip_norm: float = 0.0
    precision: str = "fp32"
    compile: bool = False
    checkpoint_every: int = 500
    validate_every: int = 1000
    log_every: int = 50

    def with_lr(self, lr: float | None) -> Self:
        """Return this optimisation with another learning rate at the start, and the final one in proportion.

        Args:
            lr: learning rate at the start; None to change nothing.
        """
        return self if lr is None else replace(self, lr=lr, final_lr=self.final_lr * lr / self.lr)

    def compute_factor(self, step: int) -> float:
        """Return the learning rate at a step as a fraction of the learning rate at the start."""
        course = SCHEDULES[self.schedule](step / self.steps, self.final_lr / self.lr, self.drop_at)
        return self.warm(step) * course

    def warm(self, step: int) -> float:
        """Return the fraction of its learning rate that a step gets: less than 1 during the warm-up."""
        return min(1.0, (step + 1) / self.warmup) if self.warmup else 1.0

    def check_installed(self) -> None:
        """Raise InputError if the optimiser's library is not installed."""

    def build(self, groups: list[dict]) -> Optimizer:
        """Make the optimiser over parameter groups; a group's own `lr` and `weight_decay` take precedence."""
        return self.build_adam(groups)

    def build_adam(self, groups: list[dict]) -> Optimizer:
        """Make Adam or AdamW over parameter groups."""
        kind = torch.optim.AdamW if self.decoupled else torch.optim.Adam
        return kind(groups, lr=self.lr, weight_decay=self.weight_decay, betas=self.betas, fused=True)

    def make_average(self, module: nn.Module, optimiser: Optimizer) -> Average:
        """Make the object that says which weights of the module count."""
        return EMA(module, self.ema) if self.ema else Average(module)


@dataclass(frozen=True)
class Muon(Optim):
    """Optimised by Muon for matrices, and by AdamW for all other parameters (Jordan et al. 2024).

    Muon's steps are scaled to the typical length of AdamW's steps (Liu et al. 2025), so that AdamW's learning
    rates and weight decay fit both. The implementation is torch.optim.Muon, which multiplies matrices in
    bfloat16. Its momentum is Nesterov momentum. The attributes are the keys of
    MuonSettings.
    """

    momentum: float = 0.95
    other_lr: float | None = None
    vectors: str = "adamw"

    def with_lr(self, lr: float | None) -> Self:
        """Return these settings with another learning rate; `other_lr` is scaled by the same factor."""
        other = super().with_lr(lr)
        if lr is None or self.other_lr is None:
            return other
        return replace(other, other_lr=self.other_lr * lr / self.lr)

    def check_installed(self) -> None:
        """Raise InputError if torch has no Muon."""
        if not hasattr(torch.optim, "Muon"):
            raise InputError(f"optim=muon: torch {torch.__version__} does not have Muon; needs 2.9 or newer")

    def build(self, groups: list[dict]) -> Optimizer:
        """Make both optimisers as one; see Optim."""
        self.check_installed()
        matrices, rest = _split(groups, least=1 if self.vectors == "muon" else 2)
        parts: list[Optimizer] = []
        if matrices:
            keys = self.lr, self.weight_decay, self.momentum
            parts.append(torch.optim.Muon(matrices, *keys, adjust_lr_fn="match_rms_adamw"))
        if rest:
            parts.append(replace(self, lr=self.other_lr or self.lr, decoupled=True).build_adam(rest))
        return ComposedOptimiser(parts)


@dataclass(frozen=True)
class ScheduleFree(Optim):
    """Optimised by schedule-free AdamW (Defazio et al. 2024) of the package schedulefree.

    It averages the weights itself and has no schedule but the warm-up: `schedule`, `final_lr`, `drop_at` and
    `ema` have no effect.
    """

    def compute_factor(self, step: int) -> float:
        """Return the learning rate at a step as a fraction of `lr`."""
        return self.warm(step)

    def check_installed(self) -> None:
        """Raise InputError if the package is not installed."""
        if find_spec("schedulefree") is None:
            raise InputError(
                "optim=schedule_free: needs the package schedulefree; pip install 'memmlp[schedulefree]'"
            )

    def build(self, groups: list[dict]) -> Optimizer:
        """Make the optimiser, ready to train; see Optim."""
        self.check_installed()
        from schedulefree import AdamWScheduleFree

        optimiser = AdamWScheduleFree(groups, self.lr, self.betas, weight_decay=self.weight_decay)
        optimiser.train()
        return optimiser

    def make_average(self, module: nn.Module, optimiser: Optimizer) -> Average:
        """Make the object that says which weights count: the optimiser's own average."""
        return ScheduleFreeAverage(module, optimiser)


def _split(groups: list[dict], least: int) -> tuple[list[dict], list[dict]]:
    """Divide parameter groups into matrices of at least `least` rows and columns, and all others."""
    parts: tuple[list[dict], list[dict]] = ([], [])
    for group in groups:
        for chosen, matrices in zip(parts, (True, False), strict=True):
            own = [one for one in group["params"] if (one.dim() == 2 and min(one.shape) >= least) == matrices]
            chosen += [{**group, "params": own}] if own else []
    return parts


def vqvae_optim(steps: int, **keys: Any) -> Optim:
    """Return a VQ-VAE's optimisation: Adam, its rate times 0.2 at 20, 50 and 70 % of the steps (App. A).

    Validation is done once, at the end; `keys` are further attributes of Optim.
    """
    return Optim(
        steps, schedule="milestones", betas=(0.9, 0.99), decoupled=False, validate_every=steps, **keys
    )


class ComposedOptimiser(Optimizer):
    """Several optimisers as one, with the parameter groups and the state of all of them.

    Args:
        parts: the optimisers, which have no parameter in common.
    """

    def __init__(self, parts: Sequence[Optimizer]):
        self.parts = tuple(parts)
        super().__init__([group for part in parts for group in part.param_groups], {})
        self._share()

    def _share(self) -> None:
        start = 0
        for part in self.parts:  # each uses the groups and the state themselves, not copies
            end = start + len(part.param_groups)
            part.param_groups, part.state = self.param_groups[start:end], self.state
            start = end

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> None:  # type: ignore[override]
        """Take a step of each part; a closure is not supported."""
        with widen_products():
            for part in self.parts:
                part.step()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load the groups and the state of all parts."""
        super().load_state_dict(state_dict)
        self._share()


class WideProducts(TorchFunctionMode):
    """Within it, products of bfloat16 matrices on the CPU are computed in float32 and rounded.

    A processor without instructions for bfloat16 is six times slower at them than at float32. Products of two
    bfloat16 numbers are exact in float32, and sums are in float32, so the result is that of the instructions.
    """

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Sequence[type],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        """Call a function of torch."""
        if func in PRODUCTS and all(map(_is_narrow, args)):
            return func(*(tensor.float() for tensor in args), **(kwargs or {})).bfloat16()
        return func(*args, **(kwargs or {}))


def widen_products() -> AbstractContextManager[object]:
    """Return `WideProducts` on a processor without instructions for bfloat16, and nothing on others."""
    return nullcontext() if has_bfloat16_products() else WideProducts()


@functools.cache
def has_bfloat16_products() -> bool:
    """Return whether this processor has instructions for products of bfloat16; only x86 is asked."""
    ask: Callable[[], dict[str, Any]] = getattr(torch.cpu, "get_capabilities", dict)  # newer than some torch
    known = ask()
    return known.get("architecture") != "x86_64" or bool(known.get("avx512_bf16") or known.get("amx_bf16"))


def _is_narrow(tensor: Any) -> bool:
    return isinstance(tensor, Tensor) and tensor.dtype == torch.bfloat16 and tensor.device.type == "cpu"


class Average:
    """The weights of a module that count: they are validated, and kept at the end.

    In this base class they are the weights of the last step; a subclass may average over the steps. A
    checkpoint has both, so that a resumed training continues as if it had never stopped. Only parameters are
    averaged; buffers, such as a codebook's statistics, are the last step's.

    Args:
        module: the module that is trained.
    """

    def __init__(self, module: nn.Module):
        self.parameters = dict(module.named_parameters())

    def update(self, steps: int) -> None:
        """Update the average with the module's weights after `steps` steps."""

    def put_in_place(self) -> None:
        """Put the weights that count into the module, for good."""

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that a checkpoint must hold, their names preceded by "average."."""
        return {}

    def load(self, tensors: dict[str, Tensor]) -> None:
        """Load from a checkpoint's tensors those that `tensors` returned."""

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """Give the module the weights that count within the context, then the last step's, bit for bit."""
        before = {name: one.detach().clone() for name, one in self.parameters.items()}
        self.put_in_place()
        try:
            yield
        finally:
            self._put(before)

    @torch.no_grad()
    def _put(self, values: dict[str, Tensor]) -> None:
        for name, one in self.parameters.items():
            one.copy_(values[name])


class EMA(Average):
    """An exponential moving average of the weights.

    The decay grows to its value as (1 + steps) / (10 + steps), so that the random first weights are soon
    forgotten.

    Args:
        module: the module that is trained.
        decay: the share of the old average that is kept at each step, in (0, 1).
    """

    def __init__(self, module: nn.Module, decay: float):
        super().__init__(module)
        self.decay = decay
        self.averages = {name: one.detach().clone() for name, one in self.parameters.items()}

    def update(self, steps: int) -> None:
        decay = min(self.decay, (1 + steps) / (10 + steps))
        weights = [one.detach() for one in self.parameters.values()]
        get_ema_multi_avg_fn(decay)(list(self.averages.values()), weights, steps)

    def put_in_place(self) -> None:
        self._put(self.averages)

    def tensors(self) -> dict[str, Tensor]:
        return {f"average.{name}": value for name, value in self.averages.items()}

    def load(self, tensors: dict[str, Tensor]) -> None:
        for name, value in self.averages.items():
            value.copy_(tensors[f"average.{name}"])


class ScheduleFreeAverage(Average):
    """The average that a schedule-free optimiser maintains itself, and shows in its evaluation mode.

    Args:
        module: the module that is trained.
        optimiser: an optimiser of the package schedulefree, in its training mode.
    """

    COUNTERS = ("k", "weight_sum", "lr_max")
    """What its groups count besides their settings: steps, sum of the average's weights, largest rate."""

    def __init__(self, module: nn.Module, optimiser: Optimizer):
        super().__init__(module)
        self.optimiser = optimiser

    def put_in_place(self) -> None:
        self.optimiser.eval()  # type: ignore[attr-defined]

    @contextmanager
    def in_place(self) -> Iterator[None]:
        # The optimiser can restore the last step's weights by itself, but not bit for bit.
        with super().in_place():
            yield
            self.optimiser.train()  # type: ignore[attr-defined]

    def tensors(self) -> dict[str, Tensor]:
        counted = [[group[name] for name in self.COUNTERS] for group in self.optimiser.param_groups]
        return {"average.counters": torch.tensor(counted, dtype=torch.float64)}

    def load(self, tensors: dict[str, Tensor]) -> None:
        counted = tensors["average.counters"].tolist()
        for group, (steps, weight_sum, lr_max) in zip(self.optimiser.param_groups, counted, strict=True):
            group.update(zip(self.COUNTERS, (int(steps), weight_sum, lr_max), strict=True))
