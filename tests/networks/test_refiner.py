"""A refiner behind any network: it corrects the stream, and carries no more than its own states."""

from __future__ import annotations

import pytest
import tiny
import torch

from memmlp.config.build import build_architecture, untrained
from memmlp.config.compose import composed
from memmlp.evaluation import modes
from memmlp.evaluation.ik import Arms
from memmlp.evaluation.modes import joint_positions
from memmlp.motion.body import HANDS, POSITION, ROTATION, SPARSE_DIM, SPARSE_POSITION
from memmlp.motion.network_coordinates import Heading
from memmlp.networks.refiner import HIDDEN, Refined
from memmlp.networks.streaming import has_stream, streaming

CLIP = tiny.clip(24).double()
SPARSE = CLIP[None, :, :SPARSE_DIM]
NETWORKS = ["mem_mlp", "agrol_mlp", "avatar_poser", "hmd_poser", "rpm"]


def network(name: str) -> Refined:
    one = tiny.model(coordinates=Heading()) if name == "mem_mlp" else tiny.baseline(name, Heading())
    return tiny.refined(one).double()


@pytest.mark.parametrize("name", ["avatar_poser", "vae_hmd"])
def test_it_has_the_published_size(name):
    """VAE-HMD leaves out of its count what only training uses, behind a refiner as well."""
    bare, refined = (
        untrained(["profile=paper", f"model={name}", *words]) for words in ([], ["refiner=sage"])
    )
    assert refined.count_parameters() - bare.count_parameters() == 2_635_908


def test_none_is_the_network_itself():
    assert build_architecture(composed(["model=avatar_poser"])).refiner is None
    assert not isinstance(untrained(["model=avatar_poser", "profile=tiny"]), Refined)


@pytest.mark.slow
@pytest.mark.parametrize("name", NETWORKS)
@torch.no_grad()
def test_it_corrects_the_networks_stream(name):
    """Computed here by torch's own recurrent layers over the whole stream, frame after frame."""
    model = network(name)
    bare, made = (modes.stream(one, [CLIP])[0] for one in (model.network, model))
    expected = bare[:, ROTATION] + model.head(model.layers(bare[None, :, ROTATION])[0])[0]
    torch.testing.assert_close(made[:, ROTATION], expected)
    assert not torch.allclose(made[:, ROTATION], bare[:, ROTATION], atol=1e-3)
    positions = model.normalizer.pose(made, SPARSE[0]).flatten(1) if name != "mem_mlp" else bare[:, POSITION]
    torch.testing.assert_close(made[:, POSITION], positions)
    assert torch.equal(modes.window(model, [CLIP])[0], made)


@pytest.mark.slow
@pytest.mark.parametrize("name", NETWORKS)
@torch.no_grad()
def test_its_streaming_graph_is_it_and_carries_its_states_alone(name):
    model = network(name)
    live, inner = streaming(model), streaming(model.network)
    whole, carried = model.initial_state(1), live.initial_state()
    assert carried.keys() - inner.initial_state().keys() == {HIDDEN}
    assert carried[HIDDEN].numel() == 12
    for frame in SPARSE.split(1, 1):
        expected, whole = model.advance(frame, whole)
        found, carried = live.advance(frame, carried)
        assert float((expected - found).abs().max()) < 1e-11


@torch.no_grad()
def test_calls_of_any_size_and_clips_side_by_side():
    model = network("avatar_poser")
    stream, state, made = modes.stream(model, [CLIP])[0], model.initial_state(1), []
    for part in SPARSE.split([1, 9, 14], 1):
        motion, state = model.advance(part, state)
        made.append(motion[0])
    torch.testing.assert_close(torch.cat(made), stream)
    clips = [tiny.clip(n, seed=n).double() for n in (4, 25, 14)]
    for together, clip in zip(modes.stream(model, clips), clips, strict=True):
        torch.testing.assert_close(together, modes.stream(model, [clip])[0])


def test_what_has_no_stream_has_none_with_a_refiner():
    assert has_stream(tiny.refined(tiny.baseline("rpm")))
    assert not has_stream(tiny.refined(tiny.baseline("manikin_l", offline=True)))


@torch.no_grad()
def test_arms_that_it_moves_off_their_trackers_reach_again_by_inverse_kinematics():
    """The trackers are where the network's own hands are, so that its arms reach them."""
    model, clip = tiny.refined(tiny.recurrent_poser(Heading(), output="reaching")), tiny.clip(9)
    (first,) = modes.stream(model.network, [clip])
    hands = joint_positions(first)[:, list(HANDS)]
    clip[:, SPARSE_POSITION.start + 3 : SPARSE_POSITION.stop] = hands.flatten(1)
    (reaching,), (moved,) = modes.stream(model.network, [clip]), modes.stream(model, [clip])
    again = Arms().solutions(model.normalizer, moved, clip[:, :SPARSE_DIM])["combined"]
    found = [model.normalizer.pose(motion, clip[:, :SPARSE_DIM]) for motion in (reaching, again, moved)]
    away = [float((joints[:, list(HANDS)] - hands).norm(dim=-1).mean()) for joints in found]
    assert away[0] < 0.001
    assert away[1] < 0.02
    assert away[2] > 0.1
