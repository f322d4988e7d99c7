"""HMD-Poser, part by part."""

import numpy as np
import pytest
import tiny
import torch

from memmlp.motion.body import SPARSE_DIM, SPARSE_POSITION
from memmlp.motion.geometry import sixd_to_matrix
from memmlp.networks.hmd_poser import locate_hands

CLIP = tiny.clip(20)


def test_hands_in_the_heads_frame_are_those_of_consecutive_frames():
    """The frame before is found from the velocities; here it is taken from the clip itself."""
    poses = sixd_to_matrix(CLIP[:, :18].unflatten(-1, (3, 6))).double().numpy()
    places = CLIP[:, SPARSE_POSITION].unflatten(-1, (3, 3)).double().numpy()
    back = poses[:, :1].swapaxes(-1, -2)
    turned, place = back @ poses[:, 1:], (back @ (places[:, 1:] - places[:, :1])[..., None])[..., 0]
    between = turned[:-1].swapaxes(-1, -2) @ turned[1:]
    expected = (*(matrix[..., :2].swapaxes(-1, -2).reshape(-1, 2, 6) for matrix in (turned, between)), place)
    for found, wanted in zip(
        locate_hands(CLIP[None, :, :SPARSE_DIM]), (*expected, np.diff(place, axis=0)), strict=True
    ):
        np.testing.assert_allclose(found[0, 1:], wanted[-19:], atol=1e-5)


def test_the_shape_is_trained_to_be_the_same_within_a_window():
    model = tiny.baseline("hmd_poser", shape_weight=0.5)
    truth = torch.stack([tiny.clip(7, seed) for seed in (1, 2)])
    motion, _, losses = model.compute_training_outputs(truth[..., :SPARSE_DIM], model.initial_state(2), truth)
    torch.testing.assert_close(motion, model.advance(truth[..., :SPARSE_DIM], model.initial_state(2))[0])
    features = model.compute_features(truth[..., :SPARSE_DIM], model.initial_state(2))[0]
    shapes = model.shape(features).detach().numpy()
    expected = 0.5 * np.abs(shapes - shapes.mean(1, keepdims=True)).mean()
    assert float(losses["shape"].detach()) == pytest.approx(expected, rel=1e-4)
    plain = tiny.baseline("hmd_poser", shape_weight=0)
    assert plain.compute_training_outputs(truth[..., :SPARSE_DIM], plain.initial_state(2), truth).losses == {}
    assert model.count_parameters() - plain.count_parameters() == 8 * 16 * 16 + 16 + 16 * 16 + 16
