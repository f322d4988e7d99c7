"""The stage that evaluates, and the broken network that it refuses."""

import math
from functools import partial

import pytest
import tiny
import torch

from memmlp.evaluation.evaluation import Evaluation
from memmlp.evaluation.ik import NoIK
from memmlp.evaluation.modes import measure_stream
from memmlp.motion.network_coordinates import Heading

STREAM = Evaluation(("stream",), batch=4, ik=NoIK(), seed=0)
TEST = tiny.frames((14, 11))


RECURRENT = {
    name: partial(tiny.recurrent_poser, Heading(), output=name) for name in ["local", "global", "reaching"]
}


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
    """One that is too short for a metric is; but a network that diverges on a clip has no mean."""
    network, clips = tiny.model(), [tiny.clip(40, seed=1), tiny.clip(2, seed=2)]
    if broken:
        clips[0][20] = math.nan
    found = measure_stream(network, clips)
    assert math.isnan(found["rotation MPJPE"]) == broken
    assert math.isnan(found["rotation Jitter"]) == broken
