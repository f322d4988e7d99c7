"""MANIKIN, part by part."""

import numpy as np
import pytest
import tiny
import torch
from plain_body import posed

from memmlp.motion.body import POSITION, ROTATION, SPARSE_DIM
from memmlp.motion.geometry import forward_kinematics, sixd_to_matrix
from memmlp.motion.network_coordinates import Heading, World
from memmlp.motion.normalizer import Normalizer
from memmlp.networks import manikin
from memmlp.networks.limb_solver import BASES, ENDS, MIDDLES
from memmlp.networks.manikin import PLACED_JOINTS, PREDICTED_JOINTS, PredictedParts, TrueParts
from memmlp.networks.motion_model import MotionModel

TRUTH = torch.stack([tiny.clip(7, seed) for seed in (1, 2)]).double()
SPARSE, MOTION = TRUTH[..., :SPARSE_DIM], TRUTH[..., SPARSE_DIM:]
WORLD = Normalizer.from_coordinates(World(), tiny.REST).double()


def outputs() -> torch.Tensor:
    """What a network should predict of the true motion (2, 7, 86)."""
    true = TrueParts(MOTION)
    turned = posed_globally(MOTION)
    swivel = manikin.measure_swivels(*true.list_limb_joints(), turned[..., list(BASES), :, 1])
    places = [true.compute_vectors((15,), (7, 8)), true.compute_vectors((7, 8), (10, 11))]
    parts = [true.sixd[..., [0, *PREDICTED_JOINTS], :], swivel.transpose(-1, -2), *places]
    return torch.cat([part.flatten(-2) for part in parts], -1)


def posed_globally(motion: torch.Tensor) -> torch.Tensor:
    local = sixd_to_matrix(motion[..., ROTATION].unflatten(-1, (22, 6)))
    return forward_kinematics(local, torch.zeros_like(local[..., 0, :, 0]), tiny.REST.double())[0]


@torch.no_grad()
def test_the_true_parts_make_the_true_trunk_hands_and_ankles():
    """And the head and wrists have their trackers' rotations; elbows and knees may reach a limit of twist."""
    rotation = PredictedParts.from_outputs(outputs(), WORLD).solve_pose(SPARSE, WORLD)
    motion = WORLD.decode_rotations(rotation, SPARSE)
    made, true = (part[..., POSITION].unflatten(-1, (22, 3)) for part in (motion, MOTION))
    trunk, tracked = [0, 1, 2, 3, 6, 9, 12, 13, 14, 15, 16, 17], [15, 20, 21]
    torch.testing.assert_close(made[..., trunk, :], true[..., trunk, :], atol=1e-5, rtol=0)
    off = (made - true)[..., [*ENDS], :].norm(dim=-1)
    assert float(off.median()) < 1e-5  # a limb that reaches further than one hinge allows comes short
    assert float(off.max()) < 0.03
    found, expected = (posed_globally(part)[..., tracked, :, :] for part in (motion, MOTION))
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)
    assert float((made - true)[..., [*MIDDLES], :].norm(dim=-1).quantile(0.1)) < 1e-3


def in_world(name: str, **changes) -> MotionModel:
    model = tiny.baseline(name, World(), **changes).double()
    model.normalizer = WORLD
    return model


def filled(sixd: np.ndarray) -> np.ndarray:
    """The rotations (132,) of a body whose joints that are not predicted are not turned."""
    rotation = np.tile([1.0, 0, 0, 0, 1, 0], (22, 1))
    rotation[[0, *PREDICTED_JOINTS]] = sixd.reshape(11, 6)
    return rotation.flatten()


def test_manikin_s_losses_are_an_independent_computation():
    """In NumPy, limb by limb, with the weights of its authors."""
    model = in_world("manikin_s", root_weight=0.02)
    noise = torch.randn(2, 1, 86, generator=torch.Generator().manual_seed(1)).double()
    made = outputs()[:, -1:] + 0.1 * noise
    found = model.compute_part_losses(made, TrueParts(MOTION[:, -1:]))
    raw = made[:, 0].numpy()
    true = MOTION[:, -1, POSITION].unflatten(-1, (22, 3)).numpy()
    sixd = MOTION[:, -1, ROTATION].unflatten(-1, (22, 6)).numpy()
    rotations = [np.abs(raw[b, 6:66].reshape(10, 6) - sixd[b, list(PREDICTED_JOINTS)]) for b in (0, 1)]
    bodies = [posed(filled(raw[b, :66])) for b in (0, 1)]
    rooted = [np.abs(bodies[b] - (true[b] - true[b, 0]))[PLACED_JOINTS] for b in (0, 1)]
    ankles = [np.abs(raw[b, 74:80].reshape(2, 3) - (true[b, [7, 8]] - true[b, 15])) for b in (0, 1)]
    toes = [np.abs(raw[b, 80:].reshape(2, 3) - (true[b, [10, 11]] - true[b, [7, 8]])) for b in (0, 1)]
    swivel, middle = 0.0, 0.0
    ups = posed_globally(torch.tensor(np.stack([filled(raw[b, :66]) for b in (0, 1)])))
    for limb, (base, mid, end) in enumerate(zip(BASES, MIDDLES, ENDS, strict=True)):
        up = ups[:, base, :, 1].numpy()
        for b in (0, 1):
            a, m, e = true[b, [base, mid, end]]
            n = (e - a) / np.linalg.norm(e - a)
            u = -(up[b] - (up[b] @ n) * n)
            u /= np.linalg.norm(u)
            w, away = np.cross(u, n), (m - a) - ((m - a) @ n) * n
            angle = np.arctan2(away @ w, away @ u)
            cosine, sine = raw[b, 66 + limb], raw[b, 70 + limb]
            swivel += (abs(cosine - np.cos(angle)) + abs(sine - np.sin(angle))) / 2
            size = np.hypot(cosine, sine)
            place = a + ((m - a) @ n) * n + np.linalg.norm(away) * (cosine * u + sine * w) / size
            middle += np.abs(place - m).mean() / 2
    expected = {
        "trunk_rotation": np.mean(rotations), "trunk_position": 5 * np.mean(rooted), "swivel": 0.1 * swivel,
        "middle": middle, "ankle": 5 * np.mean(ankles), "toe": 0.3 * np.mean(toes),
        "root": 0.02 * np.abs(raw[:, :6] - sixd[:, 0]).mean(),
    }  # fmt: skip
    assert {name: float(term) for name, term in found.items()} == pytest.approx(expected, rel=1e-3)


def test_manikin_l_losses_are_nothing_for_the_truth_and_count_angles_the_short_way():
    model = in_world("manikin_l")
    auxiliary = MOTION[..., ROTATION][..., 6:]
    made = torch.cat([outputs(), auxiliary], -1)
    true = TrueParts(MOTION)
    assert all(float(term) < 1e-5 for term in model.compute_part_losses(made, true).values())
    turned = made.clone()
    swivel = made[..., 66:74].unflatten(-1, (2, 4))
    angle = torch.atan2(swivel[..., 1, :], swivel[..., 0, :]) + 0.3
    turned[..., 66:74] = 2 * torch.stack([angle.cos(), angle.sin()], -2).flatten(-2)
    turned[..., 74:77] += 0.1
    turned[..., 86:] += 0.05
    found = {name: float(term) for name, term in model.compute_part_losses(turned, true).items()}
    expected = {"trunk_rotation": 0, "swivel": 0.03, "ankle": 0.25, "toe": 0.25, "auxiliary": 0.1}
    assert found == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("name", ["manikin_s", "manikin_l"])
def test_training_is_on_windows_turned_by_any_heading_and_the_motion_is_turned_back(name, monkeypatch):
    """Each window by its own; in coordinates of the heading it makes no difference at all."""
    model, world, seen = tiny.baseline(name, Heading()).double(), in_world(name), []
    model.normalizer = Normalizer.from_coordinates(Heading(), tiny.REST).double()
    monkeypatch.setattr(torch, "rand_like", lambda like: torch.tensor([[[0.1]], [[0.7]]]).double())
    state, predicted = model.initial_state(2), world.predict_parts
    for one, atol in ((model, 1e-6), (in_world(name, turned=False), 1e-12)):
        motion, *_ = one.compute_training_outputs(SPARSE, state, TRUTH)
        expected = one.advance(SPARSE, state)[0][:, -motion.shape[1] :]
        torch.testing.assert_close(motion, expected, atol=atol, rtol=0)
    world.predict_parts = lambda encoded: (seen.append(encoded), predicted(encoded))[1]
    world.compute_training_outputs(SPARSE, state, TRUTH)
    here, there = (window[..., 36:39][:, -world.frames :] for window in (SPARSE, seen[0]))
    torch.testing.assert_close(here[..., 2], there[..., 2])
    torch.testing.assert_close(here[..., :2].norm(dim=-1), there[..., :2].norm(dim=-1))
    assert not torch.allclose(here, there, atol=1e-3)
