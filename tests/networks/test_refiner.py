"""A refiner behind any network: it corrects the stream, and carries no more than its own states."""

import pytest
import tiny
import torch

from memmlp.evaluation import modes
from memmlp.evaluation.ik import Arms
from memmlp.evaluation.modes import extract_positions
from memmlp.motion.body import HANDS, POSITION, ROTATION, SPARSE_DIM, SPARSE_POSITION
from memmlp.motion.network_coordinates import Heading

CLIP = tiny.clip(24).double()
SPARSE = CLIP[None, :, :SPARSE_DIM]


@pytest.mark.parametrize("name", ["mem_mlp", "rpm"])
@torch.no_grad()
def test_it_corrects_the_networks_stream(name):
    """Computed here by torch's own recurrent layers over the whole stream, frame after frame."""
    network = tiny.model(coordinates=Heading()) if name == "mem_mlp" else tiny.baseline(name, Heading())
    model = tiny.refined(network).double()
    bare, made = (modes.predict_stream(one, [CLIP])[0] for one in (model.network, model))
    expected = bare[:, ROTATION] + model.head(model.layers(bare[None, :, ROTATION])[0])[0]
    torch.testing.assert_close(made[:, ROTATION], expected)
    assert not torch.allclose(made[:, ROTATION], bare[:, ROTATION], atol=1e-3)
    kinematic = model.normalizer.compute_positions(made, SPARSE[0]).flatten(1)
    positions = bare[:, POSITION] if name == "mem_mlp" else kinematic
    torch.testing.assert_close(made[:, POSITION], positions)
    assert torch.equal(modes.predict_windows(model, [CLIP])[0], made)
    assert model.running_state(SPARSE[:, : model.past_frames]).keys() == model.initial_state().keys()


@torch.no_grad()
def test_arms_that_it_moves_off_their_trackers_reach_again_by_inverse_kinematics():
    """The trackers are where the network's own hands are, so that its arms reach them."""
    model, clip = tiny.refined(tiny.recurrent_poser(Heading(), output="reaching")), tiny.clip(9)
    (first,) = modes.predict_stream(model.network, [clip])
    hands = extract_positions(first)[:, list(HANDS)]
    clip[:, SPARSE_POSITION.start + 3 : SPARSE_POSITION.stop] = hands.flatten(1)
    (reaching,), (moved,) = modes.predict_stream(model.network, [clip]), modes.predict_stream(model, [clip])
    again = Arms().solutions(model.normalizer, moved, clip[:, :SPARSE_DIM])["combined"]
    away = []
    for motion in (reaching, again, moved):
        joints = model.normalizer.compute_positions(motion, clip[:, :SPARSE_DIM])
        away.append(float((joints[:, list(HANDS)] - hands).norm(dim=-1).mean()))
    assert [one < limit for one, limit in zip(away, (0.001, 0.02, 0.1), strict=True)] == [True, True, False]
