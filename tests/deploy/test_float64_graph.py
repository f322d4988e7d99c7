"""Exported steps in float64."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path

import exported
import pytest
import tiny
import torch

from memmlp.deploy.float64_graph import in_float64
from memmlp.deploy.parity import in_torch
from memmlp.motion.body import ROTATION

pytestmark = pytest.mark.slow

CLIP = tiny.clip(8)
LEAST = {"avatar_poser": 1e-12, "vae_hmd": 1e-12, "hmd_poser": 1e-6, "mem_mlp": 1e-6, "bodiffusion": 1e-4}
"""How near to torch's network a graph has to be: as near as constants that were folded in float32 allow."""


@pytest.mark.parametrize("network", LEAST)
def test_a_graph_computes_in_float64_what_its_network_does(step_files: Callable[[str], Path], network: str):
    model = exported.NETWORKS[network]().eval()
    exact = in_torch(copy.deepcopy(model).double(), CLIP.double())
    made = in_float64(step_files(network), CLIP)
    assert made.dtype is torch.float64
    assert made.shape == exact.shape
    apart = (made - exact)[:, ROTATION].abs().max()
    assert apart <= LEAST[network]
    assert apart < (in_torch(model, CLIP) - exact)[:, ROTATION].abs().max()  # as float32 is
