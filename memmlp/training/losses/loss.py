"""The interface of losses: terms by name, and how they are weighted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from memmlp.common.components import component
from memmlp.common.errors import InputError
from memmlp.common.settings import Settings, at_least, positive, setting
from memmlp.motion.body import N_JOINTS, POSITION
from memmlp.motion.normalizer import Normalizer, in_float32

Terms = dict[str, Tensor]


def joints(motion: Tensor) -> Tensor:
    """Return the joint positions (B, T, 22, 3) of motion (B, T, 198)."""
    return motion[..., POSITION].unflatten(-1, (N_JOINTS, 3))


def read_weights(settings: Settings) -> dict[str, float]:
    """Return the settings that are numbers, by name: the weights of a loss without other numbers."""
    return {name: value for name, value in asdict(settings).items() if not isinstance(value, str)}


@component("loss", "manual", builds="Manual")
@dataclass
class ManualSettings(Settings):
    """Mem-MLP's loss terms with fixed weights, which the paper found by grid search (Sec. 4.4, reading 8)."""

    rotation_all: float = setting(at_least(0), 1.0)
    rotation_velocity: float = setting(at_least(0), 30.0)
    position_branch: float = setting(at_least(0), 0.5)
    velocity_lower_body: float = setting(at_least(0), 0.1)
    hand: float = setting(at_least(0), 0.1)


@component("loss", "uncertainty", builds="Uncertainty")
@dataclass
class UncertaintySettings(Settings):
    """Mem-MLP's loss terms weighted by homoscedastic uncertainty (Eq. 5, reading 8).

    A term counts as e^-s L + s, with one learned s for each term.
    """

    # the learning rate of every s; with the network's own they would not settle
    lr: float = setting(positive(), 1.0e-2)


@dataclass
class CompleteLossSettings(Settings):
    """The settings of a complete loss, which networks without slots need; others only weight Mem-MLP's terms.

    Attributes:
        complete: whether the loss is complete.
        rotations_alone: whether it only compares rotations, so that Mem-MLP with a rotation branch can have
        it.
    """

    complete: ClassVar[bool] = True
    rotations_alone: ClassVar[bool] = False


class Fixed(nn.Module):
    """Fixed weights of the loss terms, by the terms' names."""

    def __init__(self, values: Mapping[str, float]):
        super().__init__()
        self.values = values

    def build(self, names: list[str], own: Mapping[str, float] | None = None) -> None:
        """Check that every term has a weight, adding the weights of custom terms; there is nothing to learn.

        Where a custom term has the name of a weight that no term uses, its own weight replaces that one.

        Raises:
            InputError: for a term that has no weight.
        """
        self.values = {**self.values, **(own or {})}
        if lacking := [name for name in names if name not in self.values]:
            raise InputError(f"loss.{lacking[0]}: must have a weight; known are {', '.join(self.values)}")

    def parameter_groups(self) -> list[dict]:
        """Return no parameters, since there is nothing to learn."""
        return []

    def forward(self, terms: Terms) -> Tensor:
        """Return the weighted sum of the terms."""
        return torch.stack([self.values[name] * term for name, term in terms.items()]).sum()

    def weights(self) -> Mapping[str, float]:
        """Return the weight of each term."""
        return self.values


class Manual(Fixed):
    """Fixed weights of the paper's terms (reading 8); by default those of its grid search (Sec. 4.4)."""

    def __init__(self, settings: ManualSettings | None = None):
        super().__init__(read_weights(settings or ManualSettings()))


class Uncertainty(nn.Module):
    """Weights by homoscedastic uncertainty (Kendall et al. 2018, reading 8): e^-s L + s, with one s per term.

    A term that is exactly 0, such as penetration where no foot is below the floor, leaves its s as it is: no
    weight would be largest, and e^-s would grow without bound.

    Args:
        lr: learning rate of the s; with the model's learning rate they would settle too slowly.
        values: the weights to begin with, by the terms' names; after `build` they are 1.

    Raises:
        InputError: for a weight of 0, which e^-s never is.
    """

    def __init__(self, lr: float = 1e-2, values: Mapping[str, float] | None = None):
        super().__init__()
        self.lr = lr
        if none := [name for name, value in (values or {}).items() if not value]:
            raise InputError(f"loss.{none[0]}=0: must be above 0, or null, with loss.weighting=learned")
        begin = {name: -torch.tensor(float(value)).log() for name, value in (values or {}).items()}
        self.s = nn.ParameterDict({name: nn.Parameter(s) for name, s in begin.items()})

    def build(self, names: list[str], own: Mapping[str, float] | None = None) -> None:
        """Make a parameter s, starting at 0, for each term; `own` has fixed weights and is not used."""
        self.s = nn.ParameterDict({name: nn.Parameter(torch.zeros(())) for name in names})

    def parameter_groups(self) -> list[dict]:
        """Return the parameters s, with their own learning rate and without weight decay."""
        return [{"params": list(self.s.values()), "lr": self.lr, "weight_decay": 0.0}]

    def forward(self, terms: Terms) -> Tensor:
        """Return the weighted sum of the terms."""
        return torch.stack(
            [(-(s := self.s[name])).exp() * term + s * (term.detach() != 0) for name, term in terms.items()]
        ).sum()

    def weights(self) -> Mapping[str, float]:
        """Return the present weight e^-s of each term."""
        return {name: float((-s.detach()).exp()) for name, s in self.s.items()}


Weighting = Fixed | Uncertainty


class Loss(nn.Module):
    """The interface of losses: terms by name, and their weighted sum."""

    weighting: Weighting

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return each term by name.

        Args:
            motion: predicted motion (B, T, 198), world.
            truth: true motion (B, T, 198), world.
            sparse: inputs (B, T, 54), world.
            normalizer: converts between the world and network space.
        """
        raise NotImplementedError

    def forward(
        self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer
    ) -> tuple[Tensor, Terms]:
        """Return the loss and its unweighted terms; the arguments are those of `terms`.

        The loss is computed in float32, whatever the motion's precision: velocities and jerk are small
        differences.
        """
        with in_float32(truth.device):
            terms = self.terms(motion.to(truth.dtype), truth, sparse, normalizer)
            return self.weighting(terms), terms
