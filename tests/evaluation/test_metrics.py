"""Metrics against a plain NumPy computation, and predictors whose scores are known."""

import math

import numpy as np
import pytest
import tiny
import torch
from scipy.spatial.transform import Rotation

from memmlp.evaluation import metrics
from memmlp.evaluation.ik import NoIK
from memmlp.evaluation.metric_facts import METRIC_SETS
from memmlp.evaluation.modes import Evaluation, predict_stream, predict_windows
from memmlp.motion.body import MOTION_DIM
from memmlp.networks.motion_model import MotionModel


def random_positions(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.cumsum(rng.normal(size=(count, 22, 3)) * 0.01, 0)


def random_rotations(rng: np.random.Generator, count: int, near_pi: bool = True) -> np.ndarray:
    axis = rng.normal(size=(count, 22, 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    limits = (math.pi - 1e-3, math.pi - 1e-6) if near_pi else (0, 3)
    angle = rng.uniform(*limits, (count, 22, 1))
    return Rotation.from_rotvec((axis * angle).reshape(-1, 3)).as_matrix().reshape(count, 22, 3, 3)


@pytest.mark.parametrize(("near_pi", "seed"), [(False, 0), (True, 0), (True, 1)])
def test_angles_are_numpys(near_pi, seed):
    rng = np.random.default_rng(seed)
    a, b = random_rotations(rng, 12, near_pi), random_rotations(rng, 12, near_pi and seed > 0)
    one, other = (Rotation.from_matrix(m[:, 1:].reshape(-1, 3, 3)) for m in (a, b))
    report = metrics.measure_rotations(torch.tensor(a), torch.tensor(b))
    expected = np.rad2deg((one.inv() * other).magnitude().mean())
    assert report["geodesic"] == pytest.approx(expected, abs=1e-5)


ROOTLESS = {
    "Upper PE": [3, 6, 9, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21], "Lower PE": [1, 2, 4, 5, 7, 8, 10, 11],
}  # fmt: skip
DIFFERENCES = {
    "wrapped": lambda one: (one + np.pi) % (2 * np.pi) - np.pi, "plain": lambda one: one,
    "turned": lambda one: Rotation.from_rotvec(one).as_rotvec(),
}  # fmt: skip
AGROL = "wrapped", 1, "Lower PE", slice(None)
RELEASED = {  # MPJRE's differences and first joint, the group with the root, the frames
    "agrol": AGROL, "hmd_poser": AGROL, "avatar_poser": AGROL, "sage": ("turned", *AGROL[1:]),
    "rpm": ("wrapped", 0, "Lower PE", slice(59, None)), "ego_poser": ("plain", 1, "", slice(79, None)),
    "avatar_jlm": ("plain", 1, "Upper PE", slice(None)), "bodiffusion": ("plain", 1, "", slice(0, 121)),
    "manikin": ("plain", 1, "Upper PE", slice(None)),
}  # fmt: skip


@pytest.mark.parametrize("name", RELEASED)
def test_a_released_test_is_numpys(name: str):
    rng, (angles, first, rooted, frames) = np.random.default_rng(0), RELEASED[name]
    turned, placed = ([draw(rng, 130) for _ in "ab"] for draw in (random_rotations, random_positions))
    pairs = [tuple(map(torch.tensor, pair)) for pair in (turned, placed)]
    found = metrics.measure_as_released(METRIC_SETS[name], *pairs)
    difference = placed[0][frames] - placed[1][frames]
    error, velocity = 100 * np.linalg.norm(difference, axis=-1), np.diff(difference, axis=0)
    expected = {"MPJPE": error.mean(), "MPJVE": 6000 * np.linalg.norm(velocity, axis=-1).mean()}
    expected |= {"Hand PE": error[:, [20, 21]].mean(), "Root PE": error[:, 0].mean()}
    for group, joints in ROOTLESS.items():
        expected[group] = error[:, [*([0] if rooted == group else []), *joints]].mean()
    for group, motion in zip(("Jitter", "GT Jitter"), placed, strict=True):
        expected[group] = np.linalg.norm(np.diff(motion[frames], 3, axis=0), axis=-1).mean() * 2160
    one, other = (Rotation.from_matrix(m[frames, first:].reshape(-1, 3, 3)).as_rotvec() for m in turned)
    expected["MPJRE"] = np.rad2deg(np.abs(DIFFERENCES[angles](one - other)).mean())
    assert found == pytest.approx({key: expected[key] for key in METRIC_SETS[name].metrics}, rel=1e-6)
    if name == "agrol":
        usual = metrics.measure_positions(*pairs[1]) | metrics.measure_rotations(*pairs[0])
        assert {key: usual[key] for key in found} == pytest.approx(found)
    few = metrics.measure_as_released(METRIC_SETS[name], pairs[0], tuple(one[:40] for one in pairs[1]))
    assert (not few) == (name in ("rpm", "ego_poser", "bodiffusion"))


class Counter(MotionModel):
    """A network that numbers its calls: frames' outputs show which call each came from."""

    calls = 0

    def advance(self, sparse, state, newest=None):
        self.calls += 1
        return torch.full((len(sparse), newest or self.frames, MOTION_DIM), float(self.calls)), state


def test_windows_do_not_overlap_and_the_tail_is_shifted_back():
    clip, normalizer = tiny.clip(17), tiny.normalizer()
    calls = predict_windows(Counter(normalizer, 7), [clip])[0][:, 0]
    assert calls.tolist() == [1.0] * 7 + [2.0] * 7 + [3.0] * 3
    assert predict_stream(Counter(normalizer, 7), [clip])[0][:, 0].tolist() == list(range(1, 18))


@pytest.mark.parametrize("length", [15, 21])
def test_the_tail_window_recalls_the_window_before_it(length, monkeypatch):
    """A past that is a whole window ago is that of the tail's own frames, not of the call before."""
    model = tiny.model(shift="window")
    clips = [tiny.clip(length), tiny.clip(21)]
    for clip in clips:
        clip[:, 20] = torch.arange(1, len(clip) + 1)  # an angular velocity, which is that in all coordinates
    recall, seen = model.memory.recall, []

    def spied(sparse, state, new):
        past, (mean, std) = recall(sparse, state, new), (model.normalizer.mean[20], model.normalizer.std[20])
        marks = [x[-1, :, 20] * std + mean for x in (sparse, past.sparse)]
        seen.append([mark.round().int().tolist() for mark in marks])
        return past

    monkeypatch.setattr(model.memory, "recall", spied)
    predict_windows(model, clips)
    inputs, recalled = seen[2]
    assert inputs[-7:] == list(range(length - 6, length + 1))
    assert recalled == list(range(length - 13, length - 6))


def test_the_mean_is_over_clips_and_a_clip_too_short_for_jitter_does_not_count():
    split = tiny.frames((40, 10))
    model = tiny.model()
    results = Evaluation(["stream"], 2, NoIK(), 0).report(model, split, "stream")
    per_clip = [row["rotation"]["MPJPE"] for row in results["clips"]]
    assert results["mean"]["rotation"]["MPJPE"] == pytest.approx(np.mean(per_clip), rel=1e-6)
    split, model = tiny.frames((3, 30)), tiny.model()
    results = Evaluation(["stream"], 2, NoIK(), 0).report(model, split, "stream")
    assert math.isnan(results["clips"][0]["rotation"]["Jitter"])
    expected = results["clips"][1]["rotation"]["Jitter"]
    assert results["mean"]["rotation"]["Jitter"] == pytest.approx(expected)
