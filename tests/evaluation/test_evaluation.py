"""The stage that evaluates, and the broken network that it refuses."""

import math

import pytest
import tiny
import torch

from memmlp.evaluation.ik import NoIK
from memmlp.evaluation.metric_facts import METRIC_SETS
from memmlp.evaluation.modes import Evaluation, average_clips, measure_clip, measure_stream
from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.network_coordinates import Heading

STREAM = Evaluation(("stream",), batch=4, ik=NoIK(), seed=0)
TEST = tiny.frames((14, 11))


def test_a_rotation_of_zeros_or_parallel_columns_is_no_rotation():
    motion, truth = tiny.clip(8)[:, SPARSE_DIM:].clone(), tiny.clip(8)
    sound = measure_clip(tiny.normalizer(Heading()), motion, truth)
    assert sound["rotation"]["MPJRE"] == pytest.approx(0, abs=1e-2)
    for columns in ([0.0] * 6, [1.0, 0.0, 0.0, 2.0, 0.0, 0.0]):
        broken = motion.clone()
        broken[3, 12:18] = torch.tensor(columns)
        found = measure_clip(tiny.normalizer(Heading()), broken, truth)
        assert math.isnan(found["rotation"]["MPJRE"])
        assert math.isnan(found["rotation"]["MPJPE"])
        assert found["position"] == sound["position"]


def test_released_tests_read_columns_as_they_are():
    """Long columns change nothing here, and everything in AGRoL's test, which SAGE-Net's does not share."""
    truth, motion = tiny.clip(8), tiny.clip(8, 1)[:, SPARSE_DIM:].clone()
    sound = measure_clip(tiny.normalizer(Heading()), motion, truth, metric_set=METRIC_SETS["agrol"])
    names = METRIC_SETS["agrol"].metrics
    assert sound["authors"] == pytest.approx({name: sound["rotation"][name] for name in names}, rel=1e-4)
    motion[:, 6:12] *= 1.2
    for name in ("agrol", "sage"):
        found = measure_clip(tiny.normalizer(Heading()), motion, truth, metric_set=METRIC_SETS[name])
        assert found["rotation"] == pytest.approx(sound["rotation"], rel=1e-4)
        same = found["authors"]["Lower PE"] == pytest.approx(sound["authors"]["Lower PE"], rel=1e-3)
        assert same == (name == "sage")


def test_a_mean_over_a_part_of_the_clips_is_no_number_unless_the_others_are_too_short():
    rows = [
        {"rotation": {"MPJPE": 1.0, "Jitter": jitter, "own": own}}
        for jitter, own in ((2.0, 3.0), (math.nan, 5.0))
    ]
    short = average_clips(rows, [600, 3])["rotation"]
    assert short == {"MPJPE": 1, "Jitter": 2, "own": 4}
    assert math.isnan(average_clips(rows, [600, 4])["rotation"]["Jitter"])
    rows[1]["rotation"]["own"] = math.nan
    assert math.isnan(average_clips(rows, [600, 3])["rotation"]["own"])
    rows[1]["authors"] = {"MPJPE": 5.0}  # a released test that leaves out the first clip
    assert average_clips(rows, [600, 3])["authors"] == {"MPJPE": 5}


def test_a_network_that_diverged_is_evaluated_like_any_other():
    """Its rotations and the positions that follow from them are no numbers, which is no broken network."""
    model = tiny.recurrent_poser(Heading())
    with torch.no_grad():
        next(model.parameters()).fill_(math.nan)
    found = STREAM.report(model, TEST, "stream")
    means = [found["mean"][branch]["MPJPE"] for branch in ("rotation", "position")]
    assert not any(map(math.isfinite, means))


@pytest.mark.parametrize("broken", [False, True])
def test_a_clip_without_numbers_is_no_clip_less(broken: bool):
    """A validation has no mean over a part of its pieces, here of one that is too short for Jitter."""
    network, clips = tiny.model(), [tiny.clip(40, seed=1), tiny.clip(2, seed=2)]
    if broken:
        clips[0][20] = math.nan
    found = measure_stream(network, clips)
    assert math.isnan(found["rotation MPJPE"]) == broken
    assert math.isnan(found["rotation MPJVE"]) == broken
    assert math.isnan(found["rotation Jitter"])
