"""The library of loss terms, computed independently, in NumPy and joint by joint."""

import itertools

import numpy as np
import pytest
import tiny
import torch
from plain_body import posed

from memmlp.common.errors import InputError
from memmlp.motion.body import PARENTS, ROTATION, SPARSE_DIM, SPARSE_POSITION
from memmlp.motion.network_coordinates import World
from memmlp.training.losses import TermsLoss
from memmlp.training.losses.terms import ERRORS, TERMS

TRUE = torch.stack([tiny.clip(9, 3), tiny.clip(9, 4)])
MADE = torch.stack([tiny.clip(9, 1), tiny.clip(9, 2)])[..., SPARSE_DIM:]
NORMALIZER = tiny.normalizer(World())


def terms(motion=MADE, truth=TRUE, error="absolute", **weights) -> dict[str, float]:
    loss = TermsLoss(error, **(weights or dict.fromkeys(TERMS, 1.0)))
    found = loss.terms(motion, truth[..., SPARSE_DIM:], truth[..., :SPARSE_DIM], NORMALIZER)
    return {name: float(term) for name, term in found.items()}


@pytest.fixture(scope="module")
def bodies() -> tuple[np.ndarray, np.ndarray]:
    """Predicted joints (2, 9, 22, 3) with the head on its tracker, and true ones."""
    made = np.apply_along_axis(posed, -1, MADE[..., ROTATION].numpy())
    made += (TRUE[..., SPARSE_POSITION][..., :3].numpy() - made[..., 15, :])[..., None, :]
    return made, TRUE[..., SPARSE_DIM:][..., ROTATION.stop :].unflatten(-1, (22, 3)).double().numpy()


def test_terms_of_positions(bodies):
    made, true = bodies
    found, error = terms(), made - true
    rooted = (made - made[..., :1, :]) - (true - true[..., :1, :])
    expected = {
        "position_from_pelvis": np.abs(rooted).mean(),
        "world_position": np.abs(error).mean(),
        "hand": np.abs(error[..., [20, 21], :]).mean(),
        "velocity": np.abs(error[:, 1:] - error[:, :-1]).mean(),
        "velocity_3": np.abs(error[:, [3, 6]] - error[:, [0, 3]]).mean(),
        "velocity_5": np.abs(error[:, 5] - error[:, 0]).mean(),
        "acceleration": np.abs(error[:, 2:] - 2 * error[:, 1:-1] + error[:, :-2]).mean(),
        "jerk": np.linalg.norm(np.diff(made, 3, axis=1), axis=-1).mean(),
    }
    assert {name: found[name] for name in expected} == pytest.approx(expected, rel=1e-3)


def test_terms_of_feet(bodies):
    """The true feet stand in some frames and not in others."""
    made, truth = bodies[0], TRUE.clone()
    feet = truth[..., SPARSE_DIM + ROTATION.stop :].unflatten(-1, (22, 3))
    feet[0, 3:6, [7, 10]] = feet[0, 3:4, [7, 10]]
    truth = torch.cat([truth[..., : SPARSE_DIM + ROTATION.stop], feet.flatten(-2)], -1)
    true, joints = feet.double().numpy(), [7, 8, 10, 11]
    floor = true[..., 2].min((1, 2), keepdims=True)
    stands = np.linalg.norm(np.diff(true[:, :, joints], axis=1), axis=-1) <= 0.01  # (2, 8, 4)
    slides = np.abs(np.diff(made[:, :, joints], axis=1)) * stands[..., None]
    heights = np.abs(made[:, 1:, [10, 11], 2] - floor) * stands[..., 2:]
    depths = np.maximum(floor[..., 0] - made[..., 2].min(-1), 0)
    assert 0 < stands.sum() < 64
    expected = {"contact": slides.mean(), "foot_height": heights.mean(), "penetration": depths.mean()}
    found = terms(truth=truth)
    assert {name: found[name] for name in expected} == pytest.approx(expected, rel=1e-3)
    assert expected["penetration"] > 0


def plain_rotations(motion: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Local and global rotations (2, 9, 22, 3, 3), by Gram-Schmidt and down the tree, in NumPy."""
    x, y = np.moveaxis(motion[..., ROTATION].double().numpy().reshape(2, 9, 22, 2, 3), -2, 0)
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    y = y - (x * y).sum(-1, keepdims=True) * x
    y = y / np.linalg.norm(y, axis=-1, keepdims=True)
    local = np.stack([x, y, np.cross(x, y)], -1)
    turned = local.copy()
    for joint, parent in enumerate(PARENTS[1:], start=1):
        turned[:, :, joint] = turned[:, :, parent] @ local[:, :, joint]
    return local, turned


def test_terms_of_rotations():
    """Of random motion: 6D numbers, velocities on SO(3), global rotations, and angles by their traces."""
    (made, made_globally), (true, true_globally) = map(plain_rotations, (MADE, TRUE[..., SPARSE_DIM:]))
    sixd = (MADE - TRUE[..., SPARSE_DIM:])[..., ROTATION].double().numpy()
    turns = [one[:, :-1].swapaxes(-1, -2) @ one[:, 1:] for one in (made, true)]
    trace = np.trace(made_globally.swapaxes(-1, -2) @ true_globally, axis1=-2, axis2=-1)
    expected = {
        "orientation": np.abs(sixd[..., :6]).mean(),
        "rotation": np.abs(sixd[..., 6:]).mean(),
        "sixd_velocity": np.abs(np.diff(sixd, axis=1)).mean(),
        "turn": np.abs((turns[0] - turns[1])[..., :2]).mean(),
        "global_rotation": np.abs((made_globally - true_globally)[..., :2]).mean(),
        "angle": np.arccos(np.clip((trace - 1) / 2, -1, 1)).mean(),
    }
    assert terms(**dict.fromkeys(expected, 1.0)) == pytest.approx(expected, rel=1e-3)


def test_errors_are_of_components_or_of_joints_and_terms_are_weighted(bodies):
    made, true = bodies
    error = made - true
    expected = {
        "absolute": np.abs(error).mean(),
        "square": (error**2).mean(),
        "norm": np.linalg.norm(error, axis=-1).mean(),
        "smooth": np.where(np.abs(error) < 1, error**2 / 2, np.abs(error) - 0.5).mean(),
    }
    found = {name: terms(error=name, world_position=1.0)["world_position"] for name in ERRORS}
    assert found == pytest.approx(expected, rel=1e-3)
    loss = TermsLoss(rotation=2.0, jerk=None, hand=0.5)
    total, parts = loss(MADE, TRUE[..., SPARSE_DIM:], TRUE[..., :SPARSE_DIM], NORMALIZER)
    assert list(parts) == ["rotation", "hand"]
    assert float(total) == pytest.approx(2 * float(parts["rotation"]) + 0.5 * float(parts["hand"]))
    with pytest.raises(InputError, match=r"loss=terms: .*weight"):
        TermsLoss(rotation=None)


def test_released_columns_are_not_made_orthonormal():
    """In global rotations as they are; in positions as the rotations that are read from them."""
    long = MADE.clone()
    long[..., 6:12] *= 1.1  # both columns of the left hip
    columns = [part[..., ROTATION].double().numpy().reshape(-1, 22, 2, 3) for part in (long, TRUE[..., 54:])]
    chains = [np.concatenate([c, np.cross(c[:, :, :1], c[:, :, 1:])], 2).swapaxes(-1, -2) for c in columns]
    for turned, joint in itertools.product(chains, range(1, 22)):
        turned[:, joint] = turned[:, PARENTS[joint]] @ turned[:, joint]
    expected = np.abs(chains[0][..., :2] - chains[1][..., :2]).mean()
    assert terms(long, columns="released", global_rotation=1.0)["global_rotation"] == pytest.approx(expected)
    usual, released = (terms(long, columns=one, world_position=1.0) for one in (None, "released"))
    assert usual == terms(world_position=1.0) != released


def test_every_term_reaches_the_rotations():
    truth = TRUE.clone()
    feet = SPARSE_DIM + ROTATION.stop
    truth[:, :, feet:] = truth[:, :1, feet:]  # all feet stand
    for name in TERMS:
        motion = MADE.clone().requires_grad_()
        loss = TermsLoss(**{name: 1.0})
        loss(motion, truth[..., SPARSE_DIM:], truth[..., :SPARSE_DIM], NORMALIZER)[0].backward()
        assert torch.isfinite(motion.grad).all()
        assert float(motion.grad[..., ROTATION].abs().sum()) > 0, name


def test_learned_weights_begin_as_given_and_find_the_reciprocals_of_their_terms():
    """At the minimum of e^-s L + s, e^-s is 1 / L, whatever the weight that it begins at."""
    weights = {"rotation": 3.0, "world_position": 50.0}
    loss = TermsLoss(weighting="learned", lr=0.1, **weights)
    assert loss.weighting.weights() == pytest.approx(weights)
    given = MADE, TRUE[..., SPARSE_DIM:], TRUE[..., :SPARSE_DIM], NORMALIZER
    total, parts = loss(*given)
    expected = sum(weights[n] * float(term.detach()) - np.log(weights[n]) for n, term in parts.items())
    assert float(total.detach()) == pytest.approx(expected, rel=1e-5)
    (group,) = loss.weighting.parameter_groups()
    assert (group["lr"], group["weight_decay"], len(group["params"])) == (0.1, 0.0, 2)
    optimiser = torch.optim.Adam([group])
    for _ in range(200):
        optimiser.zero_grad()
        loss.weighting(parts).backward(retain_graph=True)
        optimiser.step()
    found = {name: weight * float(parts[name]) for name, weight in loss.weighting.weights().items()}
    assert found == pytest.approx(dict.fromkeys(weights, 1.0), rel=0.02)
