"""Inverse kinematics: its objective, its optimiser, and its place in evaluation."""

import pytest
import tiny
import torch
from torch import Tensor

from memmlp.evaluation.ik import LBFGS, Arms, JointDistance, NoIK
from memmlp.evaluation.modes import Evaluation, extract_rotations, measure_clip, predict_stream
from memmlp.motion.body import N_JOINTS, POSITION, ROTATION, SPARSE_DIM
from memmlp.motion.geometry import axis_angle_to_matrix, matrix_to_sixd
from memmlp.motion.network_coordinates import Heading

NORMALIZER = tiny.normalizer()
TRUTH = tiny.clip(40)
SPARSE, MOTION = TRUTH[:, :SPARSE_DIM], TRUTH[:, SPARSE_DIM:]
LEAVES = [10, 11, 15, 20, 21]


def perturbed(size: float, seed: int = 0) -> Tensor:
    """Return the motion (40, 198) with every rotation turned by some `size` radians and true positions."""
    draw = torch.Generator().manual_seed(seed)
    turn = size * torch.randn(len(MOTION), N_JOINTS, 3, generator=draw)
    local = extract_rotations(MOTION) @ axis_angle_to_matrix(turn)
    return torch.cat([matrix_to_sixd(local).flatten(1), MOTION[:, POSITION]], -1)


def distance(motion: Tensor) -> Tensor:
    """Return the largest distance (N,) of a joint by the rotations from that by the positions, cm."""
    target = motion[:, POSITION].unflatten(-1, (N_JOINTS, 3))
    return 100 * (NORMALIZER.compute_positions(motion, SPARSE[: len(motion)]) - target).norm(dim=-1).amax(-1)


def objective(motion: Tensor) -> JointDistance:
    """Return the objective of a motion, in float64."""
    head = SPARSE[: len(motion), 36:39].double()
    target = motion[:, POSITION].double().unflatten(-1, (N_JOINTS, 3)) - head[:, None]
    return JointDistance(extract_rotations(motion.double()), target, NORMALIZER.rest.double())


def solve(motion: Tensor, iterations: int = 15) -> Tensor:
    return LBFGS(iterations).solutions(NORMALIZER, motion, SPARSE[: len(motion)])["combined"]


def test_only_rotations_that_move_joints_are_changed():
    motion = perturbed(0.2)
    solved = solve(motion)
    assert torch.equal(solved[:, POSITION], motion[:, POSITION])
    change = (extract_rotations(solved) - extract_rotations(motion)).abs().amax((0, 2, 3))
    assert float(change[LEAVES].max()) < 1e-6
    others = [joint for joint in range(N_JOINTS) if joint not in LEAVES]
    assert float(change[others].min()) > 1e-3


def test_what_diverged_in_the_position_branch_is_no_number_after_it():
    motion = perturbed(0.1)
    motion[3, POSITION.start] = torch.nan
    motion[5, POSITION.stop - 1] = torch.inf
    known = solve(motion, 3)[:, ROTATION].isfinite()
    assert known.all(1).logical_not().nonzero()[:, 0].tolist() == [3, 5]
    assert not known[[3, 5]].any()


def test_the_objective_is_the_distance_that_is_measured():
    """It is the sum of squares over joints, the head on its tracker, as by `Normalizer.compute_positions`."""
    motion = perturbed(0.3)
    target = motion[:, POSITION].unflatten(-1, (N_JOINTS, 3))
    expected = (NORMALIZER.compute_positions(motion, SPARSE) - target).square().sum((1, 2))
    rows = torch.arange(len(motion))
    value, _ = objective(motion)(torch.zeros(len(motion), 66, dtype=torch.float64), rows)
    torch.testing.assert_close(value.float(), expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("size", [0.0, 1e-4, 1.0, 3.0])
def test_the_gradient_is_that_of_differences(size):
    measure, rows = objective(perturbed(0.3)[:4]), torch.arange(4)
    x = size * torch.randn(4, 66, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    _, gradient = measure(x, rows)
    for column, step in enumerate(1e-6 * torch.eye(66, dtype=torch.float64)):
        slope = (measure(x + step, rows)[0] - measure(x - step, rows)[0]) / 2e-6
        torch.testing.assert_close(gradient[:, column], slope, atol=1e-7, rtol=1e-6)


@pytest.mark.parametrize("angle", [0.0, torch.pi - 1e-4, torch.pi])
def test_identity_and_half_turns_give_no_nan(angle):
    """The start is the identity or half turns, of the root or all joints; the target is an ordinary pose."""
    for joints in ([0], range(N_JOINTS)):
        turn = torch.zeros(3, N_JOINTS, 3)
        turn[:, list(joints), 1] = angle
        local = axis_angle_to_matrix(turn)
        motion = torch.cat([matrix_to_sixd(local).flatten(1), MOTION[:3, POSITION]], -1)
        solved = solve(motion)
        assert torch.isfinite(solved).all()
        assert (distance(solved) < distance(motion)).all()


@pytest.mark.slow
def test_a_frame_is_solved_alike_alone_in_a_batch_and_in_chunks():
    motion = torch.cat([perturbed(0.3, seed)[:5] for seed in range(3)] + [perturbed(2.0, 9)[:5]])
    sparse = SPARSE[:5].repeat(4, 1)
    together = LBFGS(15).solutions(NORMALIZER, motion, sparse)["combined"]
    chunks = LBFGS(15, chunk=3).solutions(NORMALIZER, motion, sparse)["combined"]
    torch.testing.assert_close(chunks, together, atol=1e-5, rtol=0)
    for i in range(0, len(motion), 4):
        alone = LBFGS(15).solutions(NORMALIZER, motion[i : i + 1], sparse[i : i + 1])["combined"]
        torch.testing.assert_close(alone[0], together[i], atol=1e-5, rtol=0)
    assert torch.equal(together, LBFGS(15).solutions(NORMALIZER, motion, sparse)["combined"])


def test_evaluation_reports_a_third_branch_with_the_rotation_branchs_metrics():
    model, split = tiny.model(), tiny.frames((30, 20))
    for mode in ("window", "stream"):
        solvers = LBFGS(5), NoIK()
        results, plain = (Evaluation([mode], 8, ik, 0).report(model, split, mode) for ik in solvers)
        assert set(results["mean"]) == {"rotation", "position", "combined"}
        assert set(plain["mean"]) == {"rotation", "position"}
        assert results["mean"]["combined"].keys() == results["mean"]["rotation"].keys()
        assert results["mean"]["rotation"] == plain["mean"]["rotation"]
        assert all("combined" in row for row in results["clips"])


@torch.no_grad()
def test_arms_reach_as_those_of_a_network_that_reaches():
    """They need no positions, and leave all but head, arms and hands as they are."""
    models = [tiny.recurrent_poser(Heading(), output=output) for output in ("global", "reaching")]
    plain, reaching = (predict_stream(model, [TRUTH])[0] for model in models)
    normalizer = tiny.normalizer(Heading())
    solved = Arms().solutions(normalizer, plain, TRUTH[:, :SPARSE_DIM])["combined"]
    before, found, expected = map(extract_rotations, (plain, solved, reaching))
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=0)
    torch.testing.assert_close(found[:, :12], before[:, :12])  # legs, hips and spine
    assert torch.equal(solved[:, POSITION], plain[:, POSITION])
    report = measure_clip(normalizer, plain, TRUTH, Arms())
    assert report["combined"]["Hand PE"] < 0.8 * report["rotation"]["Hand PE"]
