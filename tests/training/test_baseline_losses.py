"""The baselines' losses, computed independently."""

import numpy as np
import pytest
import tiny
import torch
from plain_body import posed

from memmlp.motion.body import MOTION_DIM, ROTATION, SPARSE_DIM, SPARSE_POSITION
from memmlp.motion.network_coordinates import World
from memmlp.training.losses import AGRoLLoss, AvatarPoserLoss, RPMLoss
from memmlp.training.losses.baseline_losses import (
    AGRoLLossSettings,
    AvatarPoserLossSettings,
    RPMLossSettings,
)
from memmlp.training.train_refiner import SAGERefinerLoss

CLIP = tiny.clip(40)
SPARSE = CLIP[None, :, :SPARSE_DIM]
DRAWN = [torch.randn(2, 3, MOTION_DIM, generator=torch.Generator().manual_seed(i)) for i in (1, 2)]


@pytest.mark.parametrize("error", ["norm", "square"])
def test_agrols_loss_is_that_of_its_code_or_of_its_paper(error):
    """The mean over frames and joints of each joint's L2 norm, or the mean of squares, in network space."""
    (motion, truth), normalizer = DRAWN, tiny.normalizer(World())
    loss, terms = AGRoLLoss(AGRoLLossSettings(error))(
        motion, truth, SPARSE[:, :3].expand(2, -1, -1), normalizer
    )
    scaled = (motion - truth)[..., ROTATION].numpy() / normalizer.std[SPARSE_DIM:][ROTATION].numpy()
    norms = [np.sqrt((scaled[b, t, 6 * j : 6 * j + 6] ** 2).sum()) for b, t, j in np.ndindex(2, 3, 22)]
    expected = {"norm": np.mean(norms), "square": np.mean(scaled**2)}
    assert float(loss) == pytest.approx(expected[error], rel=1e-4)
    assert set(terms) == {"rotation_all"}
    assert float(AGRoLLoss()(motion, truth, SPARSE[:, :3].expand(2, -1, -1), normalizer)[0]) == pytest.approx(
        expected["norm"], rel=1e-4
    )


@pytest.mark.parametrize("anchor", ["pelvis", "head"])
def test_avatar_posers_loss_compares_bodies_at_the_pelvis_or_at_the_tracker(anchor):
    """Joint by joint down the tree, in NumPy; by default as its released code has it."""
    (motion, truth), normalizer = DRAWN, tiny.normalizer(World())
    sparse = SPARSE[:, :3].expand(2, -1, -1)
    loss, terms = AvatarPoserLoss(AvatarPoserLossSettings(anchor=anchor))(motion, truth, sparse, normalizer)
    difference = (motion - truth)[..., ROTATION].numpy()
    errors = []
    for b, t in np.ndindex(2, 3):
        body = posed(motion[b, t, ROTATION].numpy())
        true = truth[b, t, ROTATION.stop :].numpy().reshape(22, 3)
        head = sparse[b, t, SPARSE_POSITION][:3].numpy()
        pair = {"pelvis": (body, true - true[0]), "head": (body + head - body[15], true)}
        errors.append(np.abs(pair[anchor][0] - pair[anchor][1]))
    expected = {
        "orientation": np.abs(difference[..., :6]).mean(),
        "rotation": np.abs(difference[..., 6:]).mean(),
        "position": np.mean(errors),
    }
    assert {name: float(term) for name, term in terms.items()} == pytest.approx(expected, rel=1e-4)
    weights = {"orientation": 0.02, "rotation": 1.0, "position": 1.0}
    assert float(loss) == pytest.approx(sum(weights[name] * expected[name] for name in weights), rel=1e-4)
    assert (float(AvatarPoserLoss()(motion, truth, sparse, normalizer)[0]) == float(loss)) == (
        anchor == "pelvis"
    )


def both_bodies(
    motion: torch.Tensor, truth: torch.Tensor, sparse: torch.Tensor
) -> tuple[np.ndarray, np.ndarray]:
    """Joints (B, T, 22, 3): predicted ones by forward kinematics with the head on its tracker; true ones."""
    frames = list(np.ndindex(*motion.shape[:2]))
    made = np.array([posed(motion[b, t, ROTATION].numpy()) for b, t in frames])
    heads = np.array([sparse[b, t, SPARSE_POSITION][:3].numpy() for b, t in frames])
    made += (heads - made[:, 15])[:, None]
    shape = (*motion.shape[:2], 22, 3)
    return made.reshape(shape), truth[..., ROTATION.stop :].numpy().reshape(shape)


def test_rpms_loss_has_l1_norms_of_joints_and_counts_the_last_frames_step_as_right():
    (motion, truth), normalizer = DRAWN, tiny.normalizer(World())
    sparse = SPARSE[:, :3].expand(2, -1, -1)
    made, true = both_bodies(motion, truth, sparse)
    scaled = (motion - truth)[..., ROTATION].numpy() / normalizer.std[SPARSE_DIM:][ROTATION].numpy()
    expected = {}
    for names, error in (
        (("rotation_all", "rotation_velocity"), scaled.reshape(2, 3, 22, 6)),
        (("world_position", "velocity"), made - true),
    ):
        steps = [np.abs(error[:, t + 1] - error[:, t]).sum(-1) for t in range(2)] + [np.zeros((2, 22))]
        expected |= dict(zip(names, (np.abs(error).sum(-1).mean(), np.mean(steps)), strict=True))
    loss, terms = RPMLoss()(motion, truth, sparse, normalizer)
    assert {name: float(term) for name, term in terms.items()} == pytest.approx(expected, rel=1e-4)
    assert float(loss) == pytest.approx(sum(expected.values()), rel=1e-4)
    weighed, _ = RPMLoss(RPMLossSettings(0.0, 2.0, 3.0, 0.0))(motion, truth, sparse, normalizer)
    whole = 2 * expected["rotation_velocity"] + 3 * expected["world_position"]
    assert float(weighed) == pytest.approx(whole, rel=1e-4)


def test_the_refiners_loss_is_mostly_of_how_rotations_move():
    clips = tiny.clip(9, 4), tiny.clip(9, 8)
    motion, truth = (clip[None, :, SPARSE_DIM:] for clip in clips)
    sparse = clips[1][None, :, :SPARSE_DIM]
    made, true = both_bodies(motion, truth, sparse)
    error = (motion - truth)[..., ROTATION].numpy()[0]

    def smooth(x: np.ndarray) -> float:
        return float(np.where(np.abs(x) < 1, 0.5 * x**2, np.abs(x) - 0.5).mean())

    rooted = made[0] - made[0][:, :1]
    jerks = [rooted[t + 3] - 3 * rooted[t + 2] + 3 * rooted[t + 1] - rooted[t] for t in range(6)]
    expected = {
        "rotation_all": smooth(error),
        "rotation_velocity": smooth(error[1:] - error[:-1]),
        "rotation_velocity_3": smooth(error[3::3] - error[:-3:3]),
        "position_from_pelvis": np.linalg.norm(rooted - (true[0] - true[0][:, :1]), axis=-1).mean(),
        "trackers": smooth((made - true)[0][:, [15, 20, 21]]),
        "jerk": np.linalg.norm(jerks, axis=-1).mean(),
    }
    loss, terms = SAGERefinerLoss()(motion, truth, sparse, tiny.normalizer(World()))
    assert {name: float(term) for name, term in terms.items()} == pytest.approx(expected, rel=1e-3)
    weights = dict(zip(expected, (0.01, 60.0, 20.0, 0.01, 0.01, 0.03), strict=True))
    assert float(loss) == pytest.approx(sum(weights[name] * expected[name] for name in weights), rel=1e-3)
