"""Tensors of earlier versions' files, which had other names."""

from __future__ import annotations

from collections.abc import Iterable

import pytest
import torch

from memmlp.networks.checkpoint import WEIGHTS, load_module, module_tensors
from memmlp.training.losses import LearnedWeights, Uncertainty
from memmlp.training.losses.terms import TERMS

FORMER = ("rotation", "rotation_velocity", "position", "velocity", "hand")
NOW = ("rotation_all", "rotation_velocity", "position_branch", "velocity_lower_body", "hand")


def weighting(names: Iterable[str]) -> Uncertainty:
    """A weighting of these terms, each with another weight."""
    made = Uncertainty()
    made.build(list(names))
    for number, s in enumerate(made.s.values()):
        torch.nn.init.constant_(s, number + 1)
    return made


def test_learned_weights_of_mem_mlps_terms_are_found_by_their_former_names():
    former = weighting(FORMER)
    now = weighting(NOW)
    expected = now.weights()
    torch.nn.init.zeros_(now.s["position_branch"])
    load_module("loss", now, module_tensors("loss", former))
    assert now.weights() == expected


@pytest.mark.parametrize("now", [NOW, tuple(TERMS)], ids=["Mem-MLP", "library"])
def test_learned_weights_are_in_the_order_of_their_former_names(now: tuple[str, ...]):
    """An optimiser's state has no names, so that in another order it would be of other weights."""
    renamed = {present: former for former, present in WEIGHTS}
    former = [renamed.get(name, name) for name in now]
    assert [renamed.get(name, name) for name in weighting(now).s] == list(weighting(former).s)


def test_weights_of_the_library_s_terms_are_found_by_their_former_names():
    """`rotation` is a term of the library, which has another meaning than Mem-MLP's of that name."""
    given = LearnedWeights({"rotation": 2.0, "position": 3.0, "velocity": 5.0})
    loaded = LearnedWeights({"rotation": 1.0, "position_from_pelvis": 1.0, "velocity": 1.0})
    load_module("loss", loaded, module_tensors("loss", given))
    expected = {"rotation": 2.0, "position_from_pelvis": 3.0, "velocity": 5.0}
    assert loaded.weights() == pytest.approx(expected)


def test_the_normalizer_of_version_0_1_is_found():
    module = torch.nn.ModuleDict({"normalizer": torch.nn.Module()})
    module["normalizer"].register_buffer("mean", torch.zeros(2))
    load_module("model", module, {"model.frame.mean": torch.ones(2)})
    torch.testing.assert_close(module["normalizer"].mean, torch.ones(2))
