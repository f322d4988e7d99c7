"""Parity of torch and ONNX Runtime over a clip: which differences are rounding, and which are not."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from pathlib import Path

import exported
import pytest
import tiny
import torch

from memmlp.deploy.export import export
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.deploy.parity import (
    MARGIN,
    ROUNDING,
    TOLERANCE,
    is_rounding,
    measure_differences,
    measure_largest_difference,
    select_parity_clips,
    stream_onnx,
    stream_torch,
)
from memmlp.motion.body import ROTATION, SPARSE_DIM
from memmlp.motion.network_coordinates import Heading
from memmlp.networks.own_past_memory import MemoryWithoutCodes
from memmlp.networks.streaming import make_streaming_graph

pytestmark = pytest.mark.slow

CLIP = tiny.clip(50)


def test_a_file_is_checked_with_a_full_past_where_a_clip_is_long_enough():
    model = exported.NETWORKS["mem_mlp"]()
    full = model.past_frames + model.frames
    clips = [tiny.clip(frames, seed=frames) for frames in (20, full + 100, 30)]
    (longest,) = select_parity_clips(model, clips)
    assert torch.equal(longest, clips[1][: full + MARGIN])
    assert [len(clip) for clip in select_parity_clips(model, clips, 2)] == [full + MARGIN, 30]
    assert [len(clip) for clip in select_parity_clips(model, clips[1:])] == [
        full + 100
    ]  # as long as the first
    assert select_parity_clips(model, clips, 0) == clips


def test_a_forgotten_past_is_a_difference_that_a_short_clip_hides():
    """A memory that always recalls nothing is like one that has nothing to recall yet."""
    model = tiny.model(MemoryWithoutCodes, coordinates=Heading())
    broken = copy.deepcopy(model)
    broken.memory.remember = lambda motion, past, state, new: {"motion": torch.zeros_like(state["motion"])}
    (clip,) = select_parity_clips(model, [tiny.clip(200)])
    long, short = (
        float((stream_torch(model, one) - stream_torch(broken, one)).abs().max())
        for one in (clip, clip[: model.frames])
    )
    assert long > TOLERANCE > short


def test_a_file_of_another_network_does_not_match(step_files: Callable[[str], Path]):
    model, path = exported.NETWORKS["mem_mlp"](), step_files("mem_mlp")
    assert measure_largest_difference(model, path, CLIP) <= TOLERANCE
    with torch.no_grad():
        model.stem.bias += 2e-3
    apart = measure_differences(model, path, CLIP)
    assert apart.max() > TOLERANCE
    assert not is_rounding(apart)


def test_almost_parallel_columns_are_no_failure(tmp_path):
    """An untrained network makes such 6D columns: equal rotations may then have joints far apart."""
    model, path = exported.NETWORKS["agrol_mlp"](), tmp_path / "step.onnx"
    mean, std = (t[SPARSE_DIM:][ROTATION].view(22, 6) for t in (model.normalizer.mean, model.normalizer.std))
    mean[9, 3:], std[9] = mean[9, :3], 4e-3
    export(make_streaming_graph(model), path, "0123456789abcdef")
    with torch.no_grad():
        model.head.bias.view(22, 6)[9, 3] += 1e-3  # 4e-6 of the rotation, the rounding of a large network
    assert measure_largest_difference(model, path, CLIP) <= TOLERANCE
    assert float((stream_torch(model, CLIP) - stream_onnx(OnnxStream(path), CLIP)).abs().max()) > TOLERANCE
    model.normalizer.rest[15] += 0.01  # of the joints alone
    assert measure_largest_difference(model, path, CLIP) > TOLERANCE


def test_larger_differences_need_a_small_median():
    few = torch.zeros(9)
    few[:4] = 1.0
    assert is_rounding(torch.full((9,), TOLERANCE))
    assert is_rounding(few)
    assert is_rounding(torch.full((9,), ROUNDING))
    assert not is_rounding(torch.full((9,), 2 * ROUNDING))
    assert not is_rounding(torch.full((9,), math.nan))
