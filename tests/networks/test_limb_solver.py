"""Limbs in closed form: they reach, they swivel, and the closed forms are what a search finds."""

import math

import numpy as np
import pytest
import tiny
import torch

from memmlp.motion.body import HEAD, N_JOINTS, SPARSE_DIM
from memmlp.motion.body import SPARSE_POSITION as PLACES
from memmlp.motion.body import SPARSE_ROTATION as TURNS
from memmlp.motion.geometry import axis_angle_to_matrix, forward_kinematics, matrix_to_sixd, sixd_to_matrix
from memmlp.networks import limb_solver as limbs
from memmlp.networks.limb_solver import BASES, ELBOWS, ENDS, MIDDLES, SHOULDERS, TOES, WRISTS

REST = tiny.REST.double()
DRAW = torch.Generator().manual_seed(0)


def drawn(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=DRAW, dtype=torch.double)


def unit(*shape: int) -> torch.Tensor:
    return torch.nn.functional.normalize(drawn(*shape), dim=-1)


def person(count: int = 40) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Local and global rotations and joints of people who move moderately."""
    local = axis_angle_to_matrix(0.3 * drawn(count, 22, 3))
    return local, *forward_kinematics(local, torch.zeros(count, 3).double(), REST)


LENGTHS = [bone.norm(dim=-1) for bone in limbs.find_bones(REST)[:2]]
"""Of the upper and lower bones of each limb (4,), the arms first."""


def reachable(base: torch.Tensor) -> torch.Tensor:
    """Ends that every limb can reach."""
    share = 0.3 + 0.65 * torch.rand(*base.shape[:2], generator=DRAW).double()
    return base + unit(*base.shape) * (share * sum(LENGTHS))[..., None]


@pytest.fixture(scope="module")
def body() -> dict[str, torch.Tensor]:
    local, turned, joints = person()
    base = joints[:, list(BASES)]
    given = {"end": reachable(base), "swivel": unit(40, 4, 2), "hands": sixd_to_matrix(drawn(40, 2, 6))}
    given["toe"] = drawn(40, 2, 3)
    made = limbs.solve_limbs(local, turned, base, *given.values(), REST)
    after = forward_kinematics(made, torch.zeros(40, 3).double(), REST)
    up = turned[:, list(BASES), :, 1]
    return {"made": made, "turned": after[0], "joints": after[1], "base": base, "up": up, **given}


def test_hands_and_ankles_come_to_their_ends_and_feet_point_to_their_toes(body):
    joints = body["joints"]
    torch.testing.assert_close(joints[:, list(BASES)], body["base"])
    torch.testing.assert_close(joints[:, list(ENDS)], body["end"], atol=1e-5, rtol=0)
    torch.testing.assert_close(body["turned"][:, list(ENDS[:2])], body["hands"])
    foot = joints[:, list(TOES)] - joints[:, list(ENDS[2:])]
    wanted = torch.nn.functional.normalize(body["toe"], dim=-1)
    torch.testing.assert_close(torch.nn.functional.normalize(foot, dim=-1), wanted, atol=1e-6, rtol=0)
    for rotation in (body["made"], body["turned"]):
        torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3).double().expand(rotation.shape))


def test_elbows_and_knees_bend_about_their_axes_and_roll_about_their_forearms(body):
    """The knee's rotation keeps the axis of flexion; the elbow's is such a bend and then a roll."""
    _, lower, axis = limbs.find_bones(REST)
    knees = body["made"][:, list(MIDDLES[2:])]
    torch.testing.assert_close(limbs.rotate(knees, axis[2:]), axis[2:].expand(40, -1, -1))
    reach = (body["end"] - body["base"]).norm(dim=-1, keepdim=True)
    bent = limbs.bend_middles(*limbs.find_bones(REST), reach)[:, :2]
    turned = limbs.rotate(bent.mT @ body["made"][:, list(MIDDLES[:2])], lower[:2])
    torch.testing.assert_close(turned, lower[:2].expand(40, -1, -1), atol=1e-9, rtol=0)


def test_a_middle_is_where_its_swivel_says_unless_its_twist_is_limited(body):
    """Unlimited bases have the swivel that was asked for; limited ones are at their limits."""
    back = body["turned"][:, [limbs.PARENTS[joint] for joint in BASES]].mT
    local = back @ body["turned"][:, list(BASES)]
    bone = torch.nn.functional.normalize(limbs.find_bones(REST)[0], dim=-1)
    cosine, sine = limbs.measure_twist(local, bone.expand(40, -1, -1))
    found = torch.atan2(sine, cosine)[..., 0].rad2deg().abs()
    limit = torch.tensor(limbs.MAX_TWIST).double()
    assert (found <= limit + 1e-6).all()
    free = found < limit - 1e-6
    assert 20 < int(free.sum()) < 140
    joints = [body["joints"][:, list(of)] for of in (BASES, MIDDLES, ENDS)]
    swivel = limbs.measure_swivels(*joints, body["up"])
    torch.testing.assert_close(swivel[free], body["swivel"][free], atol=0.02, rtol=0)
    torch.testing.assert_close(found[~free], limit.expand(40, 4)[~free])


def test_the_smallest_turn_to_a_limit_is_what_a_search_finds():
    local, bone, axis = sixd_to_matrix(drawn(6, 4, 6)), unit(4, 3), unit(6, 4, 3)
    turn = limbs.limit_twist(local, bone, axis)
    tried = torch.linspace(-math.pi, math.pi, 7201).double()[:, None, None, None]
    every = limbs.make_axis_rotations(axis.expand(7201, 6, 4, 3), tried.cos(), tried.sin()) @ local
    cosine, sine = limbs.measure_twist(every, bone.expand(7201, 6, 4, 3))
    inside = torch.atan2(sine, cosine)[..., 0].rad2deg().abs() <= torch.tensor(limbs.MAX_TWIST) + 0.3
    least = torch.where(inside, tried[..., 0].abs(), 10.0).amin(0)
    found = torch.acos(((turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1))
    assert float(least.max()) < 4
    torch.testing.assert_close(found, least, atol=0.05, rtol=0)
    assert 4 < int((least > 0.01).sum()) < 24


def test_swivels_are_an_independent_computation():
    """In NumPy: the angle of the middle about the axis, from below the base's Y axis."""
    base, middle, end, up = (drawn(5, 4, 3) for _ in range(4))
    found = limbs.measure_swivels(base, middle, end, up)
    lengths = [(one - other).norm(dim=-1, keepdim=True) for one, other in ((base, middle), (middle, end))]
    torch.testing.assert_close(limbs.place_middle(base, end, up, found, *lengths), middle)
    axis, bone, up = ((end - base).numpy(), (middle - base).numpy(), -up.numpy())
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    down, away = (part - (part * axis).sum(-1, keepdims=True) * axis for part in (up, bone))
    sizes = np.linalg.norm(down, axis=-1) * np.linalg.norm(away, axis=-1)
    cosine, sine = (down * away).sum(-1) / sizes, -(np.cross(down, away) * axis).sum(-1) / sizes
    np.testing.assert_allclose(found.numpy(), np.stack([cosine, sine], -1), atol=1e-9)


@pytest.mark.parametrize("share", [0.0, 1.0, 5.0])
def test_what_is_out_of_reach_is_a_limb_as_straight_or_bent_as_can_be_with_finite_slopes(share):
    local, turned, joints = person(3)
    base = joints[:, list(BASES)]
    end = (base + share * limbs.find_bones(REST)[0]).requires_grad_()
    swivel, toe = unit(3, 4, 2).requires_grad_(), drawn(3, 2, 3).requires_grad_()
    made = limbs.solve_limbs(local, turned, base, end, swivel, sixd_to_matrix(drawn(3, 2, 6)), toe, REST)
    assert torch.isfinite(made).all()
    (made * drawn(*made.shape)).sum().backward()
    assert all(torch.isfinite(part.grad).all() for part in (end, swivel, toe))
    if share == 5:
        straight = forward_kinematics(made, torch.zeros(3, 3).double(), REST)[1]
        assert ((straight[:, list(ENDS)] - base).norm(dim=-1) > 0.99 * sum(LENGTHS)).all()


def random_body(bend: float = 0.4, count: int = 50) -> tuple[torch.Tensor, torch.Tensor]:
    """Return global rotations (n, 22, 3, 3) and joints (n, 22, 3) of random poses."""
    draw = torch.Generator().manual_seed(1)
    straight = matrix_to_sixd(torch.eye(3).double()).expand(count, N_JOINTS, 6)
    local = sixd_to_matrix(straight + bend * torch.randn(count, N_JOINTS, 6, generator=draw).double())
    return forward_kinematics(local, torch.zeros(count, 3).double(), REST)


def inputs(joints: torch.Tensor, hands: torch.Tensor) -> torch.Tensor:
    """Return inputs (n, 54) with the head where it is, hands (n, 2, 3), and any turns of the trackers."""
    sparse = torch.zeros(len(joints), SPARSE_DIM).double()
    sparse[:, PLACES] = torch.cat([joints[:, HEAD, None], hands], 1).flatten(1)
    draw = torch.Generator().manual_seed(2)
    turns = sixd_to_matrix(torch.randn(len(joints), 3, 6, generator=draw).double())
    sparse[:, TURNS] = matrix_to_sixd(turns).flatten(1)
    return sparse


def within_reach(joints: torch.Tensor, share: float) -> torch.Tensor:
    """Return places (n, 2, 3) for the hands in random directions, at a share of the arms' length."""
    away = torch.randn(len(joints), 2, 3, generator=torch.Generator().manual_seed(3)).double()
    return joints[:, SHOULDERS] + share * sum(LENGTHS)[:2, None] * away / away.norm(dim=-1, keepdim=True)


@pytest.mark.parametrize("share", [0.3, 0.9, 1.2])
def test_hands_come_to_their_trackers_and_bones_keep_their_lengths(share: float):
    """Of a hand that is too far away the arm points at it, all but straight."""
    rotations, joints = random_body()
    hands = within_reach(joints, share)
    turned, placed = limbs.bend_arms_to_trackers(rotations, joints, inputs(joints, hands), REST)
    away = hands - joints[:, SHOULDERS]
    nearest = joints[:, SHOULDERS] + away * min(1, (1 - limbs.REACH_MARGIN) / share)
    torch.testing.assert_close(placed[:, WRISTS], nearest)
    for joint, child in ((SHOULDERS, ELBOWS), (ELBOWS, WRISTS)):
        bones = turned[:, joint] @ (REST[child] - REST[joint])[..., None]
        torch.testing.assert_close(placed[:, joint] + bones[..., 0], placed[:, child])
    torch.testing.assert_close(turned @ turned.mT, torch.eye(3).double().expand_as(turned))


def test_a_straight_arm_bends_about_its_axis_and_gradients_are_finite():
    """The arms of the rest pose are made quite straight; drawn in, their elbows go to the back."""
    rest = REST.clone()
    along = torch.tensor([[0.25, 0, 0], [-0.25, 0, 0]]).double()
    rest[ELBOWS], rest[WRISTS] = rest[SHOULDERS] + along, rest[SHOULDERS] + 2 * along
    rotations = torch.eye(3).double().expand(1, N_JOINTS, 3, 3).clone().requires_grad_()
    joints = rest[None].clone().requires_grad_()
    hands = rest[None, SHOULDERS] + 0.7 * (rest[None, WRISTS] - rest[None, SHOULDERS])
    turned, placed = limbs.bend_arms_to_trackers(rotations, joints, inputs(joints.detach(), hands), rest)
    assert (placed[0, ELBOWS, 2] - rest[ELBOWS, 2] < -0.1).all()  # Z is to the front in the rest pose
    (turned.sum() + placed.sum()).backward()
    assert all(part.grad.isfinite().all() for part in (rotations, joints))
