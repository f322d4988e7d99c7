"""The interface of losses: terms by name, and how they are weighted."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from memmlp.common.components import component
from memmlp.common.errors import InputError
from memmlp.common.settings import Settings, at_least, positive, setting
from memmlp.motion.body import N_JOINTS, POSITION
from memmlp.motion.normalizer import Normalizer, use_float32

Terms = dict[str, Tensor]


def joints(motion: Tensor) -> Tensor:
    """Return the joint positions (B, T, 22, 3) of motion (B, T, 198)."""
    return motion[..., POSITION].unflatten(-1, (N_JOINTS, 3))


def read_weights(settings: Settings) -> dict[str, float]:
    """Return the numeric settings by name, which are the weights of a loss."""
    return {name: value for name, value in asdict(settings).items() if isinstance(value, float)}


@component("loss", "manual", builds="ManualWeights")
@dataclass
class ManualSettings(Settings):
    """Mem-MLP's loss terms with fixed weights, from the paper's grid search (Sec. 4.4)."""

    rotation_all: float = setting(at_least(0), 1.0)
    rotation_velocity: float = setting(at_least(0), 30.0)
    position_branch: float = setting(at_least(0), 0.5)
    velocity_lower_body: float = setting(at_least(0), 0.1)
    hand: float = setting(at_least(0), 0.1)


@component("loss", "uncertainty", builds="UncertaintyWeights")
@dataclass
class UncertaintySettings(Settings):
    """Mem-MLP's loss terms weighted by homoscedastic uncertainty (Eq. 5; docs/readings.md, no. 8).

    A term counts as e^-s L + s, with one learned s for each term.
    """

    # learning rate of every s; with the network's learning rate, s would not converge
    lr: float = setting(positive(), 1.0e-2)


@dataclass
class CompleteLossSettings(Settings):
    """Settings of a complete loss, which networks without slots need.

    Attributes:
        complete: whether the loss is complete.
        rotations_alone: whether the loss only compares rotations. If so, Mem-MLP with only a rotation branch
            can use it.
    """

    complete: ClassVar[bool] = True
    rotations_alone: ClassVar[bool] = False


class FixedWeights(nn.Module):
    """Fixed weights of the loss terms, by the terms' names."""

    def __init__(self, values: Mapping[str, float]):
        super().__init__()
        self.values = values

    def build(self, names: list[str], own: Mapping[str, float] | None = None) -> None:
        """Add the weights of custom terms. A custom term may reuse the name of an unused weight, and then
        replaces it. Raises InputError if a term does not have a weight."""
        self.values = {**self.values, **(own or {})}
        if lacking := [name for name in names if name not in self.values]:
            raise InputError(f"loss.{lacking[0]}: must have a weight, like {', '.join(self.values)}")

    def parameter_groups(self) -> list[dict]:
        """Return an empty list, because fixed weights are not learned."""
        return []

    def forward(self, terms: Terms) -> Tensor:
        """Return the weighted sum of the terms."""
        return torch.stack([self.values[name] * term for name, term in terms.items()]).sum()

    def weights(self) -> Mapping[str, float]:
        """Return the weight of each term."""
        return self.values


class ManualWeights(FixedWeights):
    """Fixed weights of the paper's terms (docs/readings.md, no. 8)."""

    def __init__(self, settings: ManualSettings | None = None):
        super().__init__(read_weights(settings or ManualSettings()))


class UncertaintyWeights(nn.Module):
    """Weights by homoscedastic uncertainty: e^-s L + s, with one s per term (Kendall et al. 2018). A term of
    exactly 0, such as penetration of feet above the floor, leaves its s unchanged; otherwise e^-s would grow
    without bound (docs/readings.md, no. 8). `lr` is the learning rate of every s; the model's would be too
    low. `values` are initial weights by term; `build` resets all weights to 1. Raises InputError if a weight
    is 0."""

    def __init__(self, lr: float = 1e-2, values: Mapping[str, float] | None = None):
        super().__init__()
        self.lr = lr
        if none := [name for name, value in (values or {}).items() if not value]:
            raise InputError(f"loss.{none[0]}=0: must be above 0, or null, with loss.weighting=learned")
        begin = {name: -torch.tensor(float(value)).log() for name, value in (values or {}).items()}
        self.s = nn.ParameterDict({name: nn.Parameter(s) for name, s in begin.items()})

    def build(self, names: list[str], own: Mapping[str, float] | None = None) -> None:
        """Make a parameter s for each term, initially 0; `own`, the fixed weights, is not used."""
        self.s = nn.ParameterDict({name: nn.Parameter(torch.zeros(())) for name in names})

    def parameter_groups(self) -> list[dict]:
        """Return the parameters s, with their own learning rate and without weight decay."""
        return [{"params": list(self.s.values()), "lr": self.lr, "weight_decay": 0.0}]

    def forward(self, terms: Terms) -> Tensor:
        """Return the weighted sum of the terms."""
        values, s = torch.stack(list(terms.values())), torch.stack([self.s[name] for name in terms])
        return ((-s).exp() * values + s * (values.detach() != 0)).sum()

    def weights(self) -> Mapping[str, float]:
        """Return the current weight e^-s of each term."""
        return {name: float((-s.detach()).exp()) for name, s in self.s.items()}


Weighting = FixedWeights | UncertaintyWeights


class Loss(nn.Module):
    """The interface of losses: terms by name, and their weighted sum."""

    weighting: Weighting

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return the loss terms by name, for motion and truth (B, T, 198) and inputs (B, T, 54), all in the
        world."""
        raise NotImplementedError

    def forward(
        self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer
    ) -> tuple[Tensor, Terms]:
        """Return the loss and its unweighted terms; the arguments are those of `terms`. It is computed in
        float32, because velocities and jerk are small differences."""
        with use_float32(truth.device):
            terms = self.terms(motion.to(truth.dtype), truth, sparse, normalizer)
            return self.weighting(terms), terms
