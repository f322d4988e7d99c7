"""Parity of torch and ONNX Runtime over a clip: which differences are rounding, and which are not."""

import copy
import math
from collections.abc import Callable
from pathlib import Path

import exported
import pytest
import tiny
import torch

from memmlp.deploy import parity
from memmlp.deploy.parity import TOLERANCE, are_rounding_errors, select_parity_clip
from memmlp.motion.body import ROTATION, SPARSE_DIM
from memmlp.motion.network_coordinates import Heading
from memmlp.networks.own_past_memory import MemoryWithoutCodes

pytestmark = pytest.mark.slow

CLIP = tiny.clip(50)


def test_a_file_is_checked_with_a_full_past_where_a_clip_is_long_enough():
    model = exported.NETWORKS["mem_mlp"]()
    full = model.past_frames + model.frames
    clips = [tiny.clip(frames, seed=frames) for frames in (20, full + 100, 30)]
    assert torch.equal(select_parity_clip(model, clips), clips[1][: full + parity.MARGIN])
    assert len(select_parity_clip(model, clips[1:])) == full + 100  # as the first


def test_a_forgotten_past_is_a_difference_that_a_short_clip_hides():
    """A memory that always recalls nothing is like one that has nothing to recall yet."""
    model = tiny.model(MemoryWithoutCodes, coordinates=Heading())
    broken = copy.deepcopy(model)
    broken.memory.remember = lambda motion, past, state, new: {"motion": torch.zeros_like(state["motion"])}
    clip = select_parity_clip(model, [tiny.clip(200)])
    long, short = (
        float((parity.stream_torch(model, one) - parity.stream_torch(broken, one)).abs().max())
        for one in (clip, clip[: model.frames])
    )
    assert long > TOLERANCE > short


def test_a_file_of_another_network_does_not_match(step_files: Callable[[str], Path]):
    model, path = exported.NETWORKS["mem_mlp"](), step_files("mem_mlp")
    assert parity.measure_differences(model, path, CLIP).max() <= TOLERANCE
    with torch.no_grad():
        model.stem.bias += 2e-3
    apart = parity.measure_differences(model, path, CLIP)
    assert apart.max() > TOLERANCE
    assert not are_rounding_errors(apart)


def test_almost_parallel_columns_are_no_failure(monkeypatch):
    """An untrained network makes such 6D columns: equal rotations may then have joints far apart."""
    model = tiny.baseline("agrol_mlp", depth=1)
    mean, std = (t[SPARSE_DIM:][ROTATION].view(22, 6) for t in (model.normalizer.mean, model.normalizer.std))
    mean[9, 3:], std[9] = mean[9, :3], 4e-3
    other = copy.deepcopy(model)
    with torch.no_grad():
        other.head.bias.view(22, 6)[9, 3] += 1e-3  # 4e-6 of the rotation, the rounding of a large network
    monkeypatch.setattr(parity, "OnnxStream", lambda path: path)
    monkeypatch.setattr(parity, "stream_onnx", lambda network, clip: parity.stream_torch(network, clip))
    assert parity.measure_differences(model, other, CLIP).max() <= TOLERANCE
    assert (
        float((parity.stream_torch(model, CLIP) - parity.stream_torch(other, CLIP)).abs().max()) > TOLERANCE
    )
    model.normalizer.rest[15] += 0.01  # of the joints alone
    assert parity.measure_differences(model, other, CLIP).max() > TOLERANCE


def test_larger_differences_need_a_small_median():
    few = torch.zeros(9)
    few[:4] = 1.0
    for size, sound in (
        (TOLERANCE, True),
        (parity.ROUNDING, True),
        (2 * parity.ROUNDING, False),
        (math.nan, False),
    ):
        assert are_rounding_errors(torch.full((9,), size)) == sound
    assert are_rounding_errors(few)
