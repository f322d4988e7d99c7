"""Arms that reach: wrists at their trackers, bones as long, elbows on their side, the rest as it was."""

import pytest
import tiny
import torch

from memmlp.motion.body import HANDS, HEAD, N_JOINTS, POSITION, ROTATION, SPARSE_DIM
from memmlp.motion.body import SPARSE_POSITION as PLACES
from memmlp.motion.body import SPARSE_ROTATION as TURNS
from memmlp.motion.geometry import forward_kinematics, matrix_to_sixd, sixd_to_matrix
from memmlp.networks.limb_solver import ELBOWS, SHOULDERS, SLACK, WRISTS, reach_hands, use_tracker_rotations

REST = tiny.REST.double()
LENGTHS = [
    (REST[child] - REST[joint]).norm(dim=-1) for joint, child in ((SHOULDERS, ELBOWS), (ELBOWS, WRISTS))
]


def body(bend: float = 0.4, count: int = 50) -> tuple[torch.Tensor, torch.Tensor]:
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
    return joints[:, SHOULDERS] + share * sum(LENGTHS)[:, None] * away / away.norm(dim=-1, keepdim=True)


@pytest.mark.parametrize("share", [0.3, 0.9, 1.2])
def test_hands_come_to_their_trackers_and_bones_keep_their_lengths(share: float):
    """Of a hand that is too far away the arm points at it, all but straight."""
    rotations, joints = body()
    hands = within_reach(joints, share)
    turned, placed = reach_hands(rotations, joints, inputs(joints, hands), REST)
    away = hands - joints[:, SHOULDERS]
    nearest = joints[:, SHOULDERS] + away * min(1, (1 - SLACK) / share)
    torch.testing.assert_close(placed[:, WRISTS], nearest)
    for joint, child, length in zip((SHOULDERS, ELBOWS), (ELBOWS, WRISTS), LENGTHS, strict=True):
        torch.testing.assert_close(
            (placed[:, child] - placed[:, joint]).norm(dim=-1), length.expand(len(placed), 2)
        )
        bones = turned[:, joint] @ (REST[child] - REST[joint])[..., None]
        torch.testing.assert_close(placed[:, joint] + bones[..., 0], placed[:, child])
    torch.testing.assert_close(turned @ turned.mT, torch.eye(3).double().expand_as(turned))


def test_a_hand_on_its_shoulder_leaves_bones_as_long_and_turned_as_they_lie():
    """As near as that, an arm is folded in the hand's direction."""
    rotations, joints = body()
    turned, placed = reach_hands(rotations, joints, inputs(joints, within_reach(joints, 1e-6)), REST)
    for joint, child, length in zip((SHOULDERS, ELBOWS), (ELBOWS, WRISTS), LENGTHS, strict=True):
        bones = turned[:, joint] @ (REST[child] - REST[joint])[..., None]
        torch.testing.assert_close(placed[:, joint] + bones[..., 0], placed[:, child])
        torch.testing.assert_close(bones.norm(dim=-2)[..., 0], length.expand(len(placed), 2))


def test_the_elbow_stays_on_its_side_of_the_way_to_the_hand():
    rotations, joints = body()
    hands = within_reach(joints, 0.7)
    _, placed = reach_hands(rotations, joints, inputs(joints, hands), REST)
    axis = torch.nn.functional.normalize(hands - joints[:, SHOULDERS], dim=-1)

    def off_axis(positions: torch.Tensor) -> torch.Tensor:
        out = positions[:, ELBOWS] - joints[:, SHOULDERS]
        return torch.nn.functional.normalize(out - (out * axis).sum(-1, keepdim=True) * axis, dim=-1)

    same = (off_axis(placed) * off_axis(joints)).sum(-1)
    assert same.min() > 0.99  # but for what the axis of flexion adds
    assert same.median() > 0.9999


def test_head_and_wrists_turn_as_their_trackers_and_the_rest_stays():
    rotations, joints = body()
    sparse = inputs(joints, within_reach(joints, 0.7))
    seen = sixd_to_matrix(
        use_tracker_rotations(matrix_to_sixd(rotations).flatten(1), sparse).unflatten(-1, (N_JOINTS, 6))
    )
    torch.testing.assert_close(
        seen[:, [HEAD, *HANDS]], sixd_to_matrix(sparse[:, TURNS].unflatten(-1, (3, 6)))
    )
    others = [joint for joint in range(N_JOINTS) if joint not in (HEAD, *HANDS)]
    torch.testing.assert_close(seen[:, others], rotations[:, others])
    turned, placed = reach_hands(seen, joints, sparse, REST)
    kept = [joint for joint in range(N_JOINTS) if not SHOULDERS.start <= joint < ELBOWS.stop]
    assert torch.equal(turned[:, kept], seen[:, kept])
    assert torch.equal(placed[:, : ELBOWS.start], joints[:, : ELBOWS.start])


def test_bones_are_turned_the_least_way():
    """The angle of each turn is that between the bone as it was and as it is."""
    rotations, joints = body()
    turned, placed = reach_hands(rotations, joints, inputs(joints, within_reach(joints, 0.6)), REST)
    for joint, child in ((SHOULDERS, ELBOWS), (ELBOWS, WRISTS)):
        change = turned[:, joint] @ rotations[:, joint].mT
        angle = torch.acos(((change.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1))
        before, after = (one[:, child] - one[:, joint] for one in (joints, placed))
        torch.testing.assert_close(
            angle, torch.acos(torch.cosine_similarity(before, after, -1)), atol=1e-6, rtol=0
        )


def test_an_arm_that_is_right_stays_as_it_is():
    """Of a true pose with its own trackers, unless an arm is straighter than can be seen."""
    clip = tiny.clip(120).double()
    sparse, motion = clip[:, :SPARSE_DIM], clip[:, SPARSE_DIM:]
    local = sixd_to_matrix(motion[:, ROTATION].unflatten(-1, (N_JOINTS, 6)))
    rotations, _ = forward_kinematics(local, torch.zeros(120, 3).double(), REST)
    joints = motion[:, POSITION].unflatten(-1, (N_JOINTS, 3))
    turned, placed = reach_hands(rotations, joints, sparse, REST)
    bent = (joints[:, WRISTS] - joints[:, SHOULDERS]).norm(dim=-1) < 0.98 * sum(LENGTHS)
    assert bent.sum() > 20
    off = (placed - joints).norm(dim=-1)
    assert off[:, ELBOWS][bent].max() < 2e-3
    assert off[:, WRISTS].max() < 1e-3
    assert (turned - rotations)[:, ELBOWS][bent].abs().max() < 0.02


def test_a_straight_arm_bends_about_its_axis_and_gradients_are_finite():
    """The arms of the rest pose are made quite straight; drawn in, their elbows go to the back."""
    rest = REST.clone()
    for k, away in ((0, 1.0), (1, -1.0)):
        shoulder = rest[16 + k]
        rest[18 + k], rest[20 + k] = (
            shoulder + away * length * torch.eye(3)[0].double() for length in (0.25, 0.5)
        )
    rotations = torch.eye(3).double().expand(1, N_JOINTS, 3, 3).clone().requires_grad_()
    joints = rest[None].clone().requires_grad_()
    hands = rest[None, SHOULDERS] + 0.7 * (rest[None, WRISTS] - rest[None, SHOULDERS])
    turned, placed = reach_hands(rotations, joints, inputs(joints.detach(), hands), rest)
    assert (placed[0, ELBOWS, 2] - rest[ELBOWS, 2] < -0.1).all()  # Z is to the front in the rest pose
    (turned.sum() + placed.sum()).backward()
    assert rotations.grad.isfinite().all()
    assert joints.grad.isfinite().all()
