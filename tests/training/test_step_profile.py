"""The parts of a step are all there, and matrix products are found."""

from __future__ import annotations

import torch
from tiny_tasks import OPTIM, motion_task

from memmlp.training.step_profile import PHASES, step_phases
from memmlp.training.time_to_error import Learner


def test_a_training_step_has_all_parts():
    one = Learner(motion_task("forced"), OPTIM, 0, "answer")
    one.take(1)
    parts = step_phases(one.take, 2)
    assert set(parts) == set(PHASES)
    assert all(value > 0 for value in parts.values())
    assert one.steps == 3


def test_the_time_of_a_matrix_product_is_a_matrix_products():
    matrix = torch.rand(300, 300)
    parts = step_phases(lambda steps: [matrix @ matrix for _ in range(steps)], 10)
    assert parts["matrix products"] > 0
    assert parts["sampling"] == parts["optimiser"] == 0
