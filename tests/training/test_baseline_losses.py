"""The baselines' losses, computed independently."""

import numpy as np
import pytest
import tiny
import torch
from plain_body import posed

from memmlp.motion.body import MOTION_DIM, ROTATION, SPARSE_DIM, SPARSE_POSITION
from memmlp.motion.network_coordinates import World
from memmlp.training.losses import AGRoLLoss, AvatarPoserLoss, RPMLoss
from memmlp.training.losses.baseline_losses import AGRoLLossSettings, AvatarPoserLossSettings, RPMLossSettings
from memmlp.training.train_refiner import SAGERefinerLoss

MOTION, TRUTH = (torch.randn(2, 3, MOTION_DIM, generator=torch.Generator().manual_seed(i)) for i in (1, 2))
NORMALIZER = tiny.normalizer(World())
DRAWN = MOTION, TRUTH, tiny.clip(40)[None, :3, :SPARSE_DIM].expand(2, -1, -1), NORMALIZER
ERROR = (MOTION - TRUTH)[..., ROTATION].numpy()
SCALED = ERROR / NORMALIZER.std[SPARSE_DIM:][ROTATION].numpy()


def floats(terms: dict[str, torch.Tensor]) -> dict[str, float]:
    return {name: float(term) for name, term in terms.items()}


def both_bodies(
    motion: torch.Tensor, truth: torch.Tensor, sparse: torch.Tensor, *_: object
) -> tuple[np.ndarray, np.ndarray]:
    """Joints (B, T, 22, 3): predicted ones by forward kinematics with the head on its tracker; true ones."""
    made = np.apply_along_axis(posed, -1, motion[..., ROTATION].numpy())
    made += (sparse[..., SPARSE_POSITION][..., :3].numpy() - made[..., 15, :])[..., None, :]
    return made, truth[..., ROTATION.stop :].unflatten(-1, (22, 3)).numpy()


def test_agrols_loss_is_that_of_its_code_or_of_its_paper():
    """The mean over frames and joints of each joint's L2 norm, or the mean of squares, in network space."""
    norms = np.linalg.norm(SCALED.reshape(2, 3, 22, 6), axis=-1)
    for error, expected in (("norm", norms.mean()), ("square", np.mean(SCALED**2))):
        loss, terms = AGRoLLoss(AGRoLLossSettings(error))(*DRAWN)
        assert float(loss) == pytest.approx(expected, rel=1e-4)
        assert set(terms) == {"rotation_all"}
    assert float(AGRoLLoss()(*DRAWN)[0]) == pytest.approx(norms.mean(), rel=1e-4)


@pytest.mark.parametrize("anchor", ["pelvis", "head"])
def test_avatar_posers_loss_compares_bodies_at_the_pelvis_or_at_the_tracker(anchor):
    """Joint by joint down the tree, in NumPy; by default as its released code has it."""
    loss, terms = AvatarPoserLoss(AvatarPoserLossSettings(anchor=anchor))(*DRAWN)
    made, true = both_bodies(*DRAWN)
    if anchor == "pelvis":
        made, true = (body - body[..., :1, :] for body in (made, true))
    expected = {
        "orientation": np.abs(ERROR[..., :6]).mean(), "rotation": np.abs(ERROR[..., 6:]).mean(),
        "position": np.abs(made - true).mean(),
    }  # fmt: skip
    assert floats(terms) == pytest.approx(expected, rel=1e-4)
    weighted = 0.02 * expected["orientation"] + expected["rotation"] + expected["position"]
    assert float(loss) == pytest.approx(weighted, rel=1e-4)
    assert (float(AvatarPoserLoss()(*DRAWN)[0]) == float(loss)) == (anchor == "pelvis")


def test_rpms_loss_has_l1_norms_of_joints_and_counts_the_last_frames_step_as_right():
    made, true = both_bodies(*DRAWN)
    expected = {}
    for names, error in (
        (("rotation_all", "rotation_velocity"), SCALED.reshape(2, 3, 22, 6)),
        (("world_position", "velocity"), made - true),
    ):
        steps = np.diff(error, axis=1, append=error[:, -1:])
        expected |= {name: np.abs(x).sum(-1).mean() for name, x in zip(names, (error, steps), strict=True)}
    loss, terms = RPMLoss()(*DRAWN)
    assert floats(terms) == pytest.approx(expected, rel=1e-4)
    assert float(loss) == pytest.approx(sum(expected.values()), rel=1e-4)
    weighed, _ = RPMLoss(RPMLossSettings(0.0, 2.0, 3.0, 0.0))(*DRAWN)
    whole = 2 * expected["rotation_velocity"] + 3 * expected["world_position"]
    assert float(weighed) == pytest.approx(whole, rel=1e-4)


def test_the_refiners_loss_is_mostly_of_how_rotations_move():
    clips = tiny.clip(9, 4), tiny.clip(9, 8)
    motion, truth = (clip[None, :, SPARSE_DIM:] for clip in clips)
    given = motion, truth, clips[1][None, :, :SPARSE_DIM], NORMALIZER
    made, true = both_bodies(*given)
    error, rooted = (motion - truth)[..., ROTATION].numpy(), made - made[..., :1, :]

    def smooth(x: np.ndarray) -> float:
        return float(np.where(np.abs(x) < 1, 0.5 * x**2, np.abs(x) - 0.5).mean())

    expected = {
        "rotation_all": smooth(error),
        "rotation_velocity": smooth(np.diff(error, axis=1)),
        "rotation_velocity_3": smooth(error[:, 3::3] - error[:, :-3:3]),
        "position_from_pelvis": np.linalg.norm(rooted - (true - true[..., :1, :]), axis=-1).mean(),
        "trackers": smooth((made - true)[..., [15, 20, 21], :]),
        "jerk": np.linalg.norm(np.diff(rooted, 3, axis=1), axis=-1).mean(),
    }
    loss, terms = SAGERefinerLoss()(*given)
    assert floats(terms) == pytest.approx(expected, rel=1e-3)
    weights = dict(zip(expected, (0.01, 60.0, 20.0, 0.01, 0.01, 0.03), strict=True))
    assert float(loss) == pytest.approx(sum(weights[name] * expected[name] for name in weights), rel=1e-3)
