"""A network's predictions as clips: the same joints as those that are measured."""

from pathlib import Path

import numpy as np
import pytest
import torch
from tiny import REST, baseline, model
from tiny import frames as tiny_frames

from memmlp.common.errors import InputError
from memmlp.evaluation.ik import LBFGS, NoIK
from memmlp.evaluation.modes import Evaluation, predict_first_clip, predict_stream
from memmlp.evaluation.predictions import (
    ClipPredictor,
    make_clip,
    make_prediction_arrays,
    predict_clip,
    save_predictions,
)
from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.clip import Clip
from memmlp.motion.exporting import plan_export
from memmlp.motion.formats.npz import read_clip, write_clip
from memmlp.motion.geometry import compute_clip_kinematics, compute_motion_frames

NETWORK = model()
BODY = REST.numpy()


def predictor(mode: str = "stream", branch: str = "rotation", **changes) -> ClipPredictor:
    settings = {"modes": ["stream"], "batch": 2, "ik": NoIK(), "seed": 0}
    return ClipPredictor(NETWORK, mode, branch, Evaluation(**settings | changes))


def source(length: int, seed: int = 0, fps: float = 60.0) -> Clip:
    random = np.random.default_rng(seed)
    time = np.arange(length)[:, None, None] / fps
    poses = 0.5 * np.sin(random.uniform(0.5, 3, (22, 3)) * time + random.uniform(0, 6, (22, 3)))
    poses[:, 0] = [np.pi / 2, 0, 0]
    return Clip("clip", poses, np.linspace(0, 1, length)[:, None] * [1.0, 0.5, 0] + [0, 0, 0.95], fps)


def frames(clip: Clip) -> torch.Tensor:
    return compute_motion_frames(torch.tensor(clip.poses), torch.tensor(clip.trans), REST).float()


def joints(clip: Clip) -> np.ndarray:
    return compute_clip_kinematics(clip, BODY)[1]


@pytest.mark.parametrize("mode", ["stream", "window"])
def test_a_clips_joints_are_those_that_are_measured(mode: str):
    given = frames(source(30))
    (clip,) = predictor(mode).predict(["clip"], [given])
    measured = predict_clip(NETWORK, given, mode)["predicted_positions"]
    assert (clip.name, clip.fps, len(clip)) == ("clip", 60, 29)
    np.testing.assert_allclose(joints(clip), measured, atol=1e-5)


@torch.no_grad()
def test_a_network_that_draws_predicts_a_clip_alike_each_time(tmp_path: Path):
    """Files of predictions draw as the evaluation does, which is seeded."""
    network = model(blend="sampled")
    given, found = frames(source(12)), []
    for _ in range(2):
        found.append(predict_clip(network, given, "stream")["predicted_rotations"])
        torch.rand(7)
    np.testing.assert_array_equal(*found)
    evaluation, test = Evaluation(("stream",), 4, NoIK(), seed=0), tiny_frames((12,))
    for folder in (tmp_path / "a", tmp_path / "b"):
        save_predictions(evaluation, network, test, folder)
    made = [(tmp_path / name / "stream" / "clip0.npz").read_bytes() for name in "ab"]
    assert made[0] == made[1]


def test_the_truth_is_what_came_in_wherever_the_pelvis_is():
    clip = source(30)
    (truth,) = predictor(branch="truth").predict(["clip"], [frames(clip)])
    np.testing.assert_allclose(joints(truth), joints(clip)[1:], atol=1e-5)
    given, shifted = frames(source(30)), BODY + np.array([0.1, -0.24, 0.03])
    arrays = predict_clip(NETWORK, given, "stream")
    clip = make_clip("clip", arrays["predicted_rotations"], arrays["predicted_positions"], shifted)
    np.testing.assert_allclose(clip.trans + shifted[0], arrays["predicted_positions"][:, 0], atol=1e-6)


def test_inverse_kinematics_brings_it_to_the_position_branch():
    given, ik = frames(source(12)), LBFGS(5)
    (clip,) = predictor(branch="combined", ik=ik).predict(["clip"], [given])
    motion = predict_stream(NETWORK, [given])[0]
    expected = make_prediction_arrays(NETWORK.normalizer, given, motion, ik)["combined_positions"]
    np.testing.assert_allclose(joints(clip), expected, atol=1e-5)
    (plain,) = predictor(ik=ik).predict(["clip"], [given])
    assert np.abs(joints(plain) - expected).max() > 1e-3


def test_a_folder_is_predicted_as_its_clips_are(tmp_path: Path):
    """Five clips in batches of two, one of them bad, one at 120 Hz, one too short."""
    clips = {"a": source(30, 1), "b/c": source(50, 2, 120.0), "d": source(20, 3), "short": source(1)}
    for name, clip in clips.items():
        write_clip(tmp_path / "in" / f"{name}.npz", clip)
    (tmp_path / "in" / "bad.npz").write_bytes(b"none")
    report = predictor().export(plan_export(tmp_path / "in", tmp_path / "out", "npz"))
    written = [path.relative_to(tmp_path / "out").as_posix() for path in report.written]
    assert written == ["a.npz", "b/c.npz", "d.npz"]
    assert [each.file for each in report.skipped] == ["bad.npz", "short.npz"]
    assert report.skipped[1].reason.startswith("has one frame at 60 Hz")
    for name, stride in (("a", 1), ("b/c", 2), ("d", 1)):
        before = read_clip(tmp_path / "in" / f"{name}.npz", name)
        at_60 = Clip(name, before.poses[::stride], before.trans[::stride], 60.0)
        expected = predict_clip(NETWORK, frames(at_60), "stream")["predicted_positions"]
        after = read_clip(tmp_path / "out" / f"{name}.npz", name)
        assert after.fps == 60
        np.testing.assert_allclose(joints(after), expected, atol=1e-5)
        head = frames(at_60)[:, SPARSE_DIM:].unflatten(-1, (-1, 3))[:, -22 + 15]
        np.testing.assert_allclose(joints(after)[:, 15], head, atol=1e-5)


@pytest.mark.slow
def test_an_offline_network_has_no_stream_to_predict_or_to_draw(tmp_path: Path):
    offline = baseline("bodiffusion", offline=True, sampling_steps=2, depth=1)
    with pytest.raises(InputError, match="mode=stream"):
        predict_clip(offline, frames(source(30)), "stream")
    with pytest.raises(InputError, match="mode=stream"):
        ClipPredictor(offline, "stream", "rotation", Evaluation(["window"], 2, NoIK(), 0))
    assert predict_clip(offline, frames(source(30)), "window")["predicted_positions"].shape == (29, 22, 3)
    truth, predicted = predict_first_clip(offline, tiny_frames())
    assert truth.shape == predicted.shape
