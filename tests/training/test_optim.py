"""Optimisers: what each does, that a resumed training is the same training, and which weights count."""

import copy
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import pytest
import torch
from tiny_tasks import motion_task, weights
from torch import nn

from memmlp.common.errors import InputError
from memmlp.runs.run import Run
from memmlp.training.loop import train
from memmlp.training.optim import (
    EMA,
    BatchedMuon,
    ComposedOptimiser,
    Float32Products,
    Muon,
    Optim,
    ScheduleFree,
)
from memmlp.training.train_network import MotionTask

COMMON = {"steps": 12, "batch": 4, "lr": 1e-2, "checkpoint_every": 5, "log_every": 4}
OPTIMS: dict[str, Optim] = {
    "muon": Muon(**COMMON, final_lr=1e-4, schedule="cosine"),
    "muon, ema": Muon(**COMMON, ema=0.9),
    "schedule_free": ScheduleFree(**COMMON, warmup=6),
    "ema": Optim(**COMMON, ema=0.9),
}


class Kill(Exception):
    """Raised where a process is killed."""


def kill(step: int, values: dict[str, float]) -> None:
    raise Kill


def trained(optim: Optim, folder: Path, on_validation=None) -> tuple[MotionTask, Run]:
    folder.mkdir(exist_ok=True)
    task, run = motion_task("forced", optim), Run(folder)
    train(task, optim, run, 0, "optim", on_validation)
    return task, run


def same(ours: dict[str, torch.Tensor], theirs: dict[str, torch.Tensor]) -> bool:
    assert ours.keys() == theirs.keys()
    return all(torch.equal(value, theirs[name]) for name, value in ours.items())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["muon, ema", "schedule_free"])
def test_a_resumed_training_is_the_same_however_often_it_was_validated(name: str, tmp_path: Path):
    """It is killed at its validation after 7 steps, two after the last checkpoint; the other has more."""
    optim = OPTIMS[name]
    whole, run = trained(replace(optim, validate_every=2), tmp_path / "whole")
    with pytest.raises(Kill):
        trained(replace(optim, validate_every=7), tmp_path / "killed", kill)
    again, resumed = trained(replace(optim, validate_every=7), tmp_path / "killed")
    assert same(weights(run), weights(resumed))
    assert same(whole.module.state_dict(), again.module.state_dict())
    ended, _ = trained(optim, tmp_path / "killed")  # nothing is left to do
    assert same(whole.module.state_dict(), ended.module.state_dict())


@pytest.mark.parametrize(("name", "averaged"), [("ema", True), ("schedule_free", True), ("muon", False)])
def test_the_weights_that_are_validated_are_kept(name: str, averaged: bool, tmp_path: Path):
    optim, seen = OPTIMS[name], []
    task, run = motion_task("forced", optim), Run(tmp_path)

    def validate() -> dict[str, float]:
        seen.append(task.model.stem.weight.detach().clone())
        return {}

    task.validate = validate
    train(task, optim, run, 0, "validate")
    assert torch.equal(seen[-1], task.model.stem.weight)
    assert torch.equal(seen[-1], weights(run)["module.model.stem.weight"]) is not averaged


def test_schedule_free_needs_its_package():
    with patch("memmlp.training.optim.find_spec", return_value=None), pytest.raises(InputError, match="pip "):
        OPTIMS["schedule_free"].build([])


def test_muon_has_the_matrices_and_adamw_the_rest():
    matrix, row, cube = (torch.nn.Parameter(torch.rand(shape)) for shape in ((3, 4), (4,), (2, 3, 4)))
    groups = [{"params": [matrix, row]}, {"params": [cube], "lr": 0.1, "weight_decay": 0.0}]
    optimiser = replace(OPTIMS["muon"], other_lr=0.5, eps=1e-6).build(groups)
    muon, adamw = optimiser.parts
    assert [group["params"] for group in muon.param_groups] == [[matrix]]
    assert [group["params"] for group in adamw.param_groups] == [[row], [cube]]
    assert [group["eps"] for group in adamw.param_groups] == [1e-6, 1e-6]
    assert type(replace(OPTIMS["ema"], decoupled=False).build([{"params": [row]}])) is torch.optim.Adam
    assert [group["lr"] for group in optimiser.param_groups] == [1e-2, 0.5, 0.1]
    assert [group["weight_decay"] for group in optimiser.param_groups] == [1e-4, 1e-4, 0]


def test_the_warm_up_grows_in_equal_parts_and_then_the_schedule_is_what_it_was():
    plain = Optim(steps=10, batch=1, lr=1.0, final_lr=0.1, schedule="cosine")
    warm = replace(plain, warmup=4)
    parts = [warm.compute_factor(step) / plain.compute_factor(step) for step in range(10)]
    assert parts == pytest.approx([0.25, 0.5, 0.75, *[1.0] * 7])
    free = replace(OPTIMS["schedule_free"], warmup=2)
    assert [free.compute_factor(step) for step in range(4)] == [0.5, 1, 1, 1]


def test_an_exponential_moving_average_by_hand():
    """The decay is 2/11, 3/12, 4/13 and then 0.3: (1 + steps) / (10 + steps), and no more than its value."""
    model = nn.Linear(1, 1, bias=False)
    expected = model.weight.item()
    average = EMA(model, 0.3)
    for step, value in enumerate((4.0, 2.0, -1.0, 8.0), start=1):
        model.weight.data.fill_(value)
        average.update(step)
        decay = min(0.3, (1 + step) / (10 + step))
        expected = decay * expected + (1 - decay) * value
    with average.use_average():
        assert model.weight.item() == pytest.approx(expected)
    assert model.weight.item() == 8


def test_it_does_what_its_parts_do_also_after_a_rate_was_changed_and_its_state_was_loaded():
    def parts(model: nn.Linear) -> list[torch.optim.Optimizer]:
        return [torch.optim.SGD([model.weight], 0.1, momentum=0.9), torch.optim.AdamW([model.bias], lr=0.2)]

    alone = nn.Linear(3, 2)
    together, first = copy.deepcopy(alone), copy.deepcopy(alone)
    separate, composed = parts(alone), ComposedOptimiser(parts(together))
    for number in range(6):
        for model, optimisers in ((alone, separate), (together, [composed])):
            for optimiser in optimisers:
                optimiser.zero_grad()
            model(torch.ones(1, 3)).square().sum().backward()
            for optimiser in optimisers:
                for group in optimiser.param_groups:
                    group["lr"] *= 0.9
                optimiser.step()
        assert all(map(torch.equal, alone.parameters(), together.parameters()))
        if number == 2:
            state = composed.state_dict()
            composed = ComposedOptimiser(parts(together))
            composed.load_state_dict(state)
    assert not torch.equal(alone.bias, first.bias)
    assert list(composed.state_dict()["state"]) == [0, 1]


def test_products_are_exact_but_for_one_rounding():
    draw = torch.Generator().manual_seed(0)
    a, b, c = (torch.randn(shape, generator=draw).bfloat16() for shape in ((9, 30), (30, 7), (9, 7)))
    left, right, added = (x.double() for x in (a, b, c))
    with Float32Products():
        plain, method, sum_ = a @ b, a.matmul(b), torch.addmm(c, a, b, beta=-4.775, alpha=2.0)
        assert (a + 1).dtype == torch.bfloat16
    torch.testing.assert_close(plain, (left @ right).bfloat16(), rtol=2**-8, atol=0)
    expected = (-4.775 * added + 2 * left @ right).bfloat16()
    torch.testing.assert_close(sum_, expected, rtol=2**-8, atol=2**-8)
    assert torch.equal(plain, method)
    assert {x.dtype for x in (plain, method, sum_)} == {torch.bfloat16}


def test_batched_muon_takes_the_steps_of_torchs_muon():
    torch.manual_seed(0)
    start = [torch.randn(size) for size in ((24, 8), (24, 8), (8, 24), (8, 8), (24, 8))]
    results = []
    for kind in (torch.optim.Muon, BatchedMuon):
        weights = [one.clone().requires_grad_() for one in start]
        optimiser = kind(weights, 0.1, 0.3, 0.9, adjust_lr_fn="match_rms_adamw")
        for step in range(3):
            torch.manual_seed(step)
            for one in weights[: 4 + step % 2]:  # the last one does not always have a gradient
                one.grad = torch.randn_like(one)
            optimiser.step()
            optimiser.zero_grad()
        results.append([one.detach() for one in weights])
    for made, expected in zip(*results, strict=True):
        torch.testing.assert_close(made, expected, atol=2e-3, rtol=0)  # bfloat16
